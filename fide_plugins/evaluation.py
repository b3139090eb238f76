"""What a user tells of candidates becomes losses and features (Algorithm 1, lines 7 and 9)."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, TypeAlias

import numpy as np
import torch

from fide_plugins import encoders
from fide_plugins.comparison.comparison import Comparison, checked
from fide_plugins.comparison.coverage import with_coverage, without_coverage
from fide_plugins.encoders.base import PatchEncoder, as_features
from fide_plugins.encoders.own import OwnEncoder
from fide_plugins.errors import CheckpointError, FeaturesError, LossError
from fide_plugins.losses.base import as_losses
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.devices import resolve_device
from fide_plugins.runtime.schema import anything, check
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.pixels import Clipping, OnClip
from fide_plugins.views import Views
from fide_plugins.views.compared import encoder_of, loss_of

Result: TypeAlias = tuple[Float64, float, Float32 | None, torch.Tensor | None, float]
"""x (d,), loss, image (H, W, 3), tokens (T, C) of one candidate, and what the search is told."""


@dataclass(frozen=True)
class Evaluation:
    """Of n candidates: losses (n,), images (n, H, W, 3) and tokens (n, T, C), where known.

    batch: images as they were told, (n, H, W, 4) with a coverage.
    blur: standard deviation in pixels at which tokens and `told` were computed.
    told: losses (n,) at that blur, for the search; None: those of sharp images.
    """

    losses: Float64
    images: Float32 | None
    tokens: torch.Tensor | None
    batch: Float32 | None = None
    blur: float = 0.0
    told: Float64 | None = None

    def of(self, points: Float64, first: int = 0) -> Iterator[Result]:
        """One result for each of the points (n, d), from the first on."""
        nothing = [None] * (len(points) - first)
        images: Iterable[Float32 | None] = nothing if self.images is None else self.images[first:]
        tokens = nothing if self.tokens is None else [one.clone() for one in self.tokens[first:]]
        losses, told = self.losses[first:], self.losses if self.told is None else self.told
        each = losses.tolist(), images, tokens, told[first:].tolist()
        return zip(points[first:], *each, strict=True)


class Evaluator:
    """Loss and encoder for one target.

    target: picture to find, anything that `validation.images.as_target` takes, or a list of views.
    mask, weights, value_range: which pixels count, and which values are black and white, see
        `fide_plugins.views`.
    loss: name, callable, made loss, or None for "mse"; see `fide_plugins.losses`.
    encoder: name, an encoder that `encoders.make` made, or any callable of a batch; see
        `fide_plugins.encoders`.  A callable is tried on the target first.
    device: of both where they are given by name; "auto" takes CUDA where there is some, for an
        encoder only if it is a network, or if `for_network`.
    photometric, robust, background, photo: see `options.Options`.

    comparison: how renders are compared that did not make the target; None: as they are.

    Raises ImageError, OptionError, UnknownNameError, DeviceError, or what the encoder raises.
    """

    def __init__(
        self,
        target: object,
        loss: str | Callable[..., object] | None,
        encoder: str | Callable[..., object],
        *,
        mask: object = None,
        weights: object = None,
        value_range: object = None,
        device: str = "auto",
        for_network: bool = False,
        photometric: str | None = None,
        robust: float | str | None = None,
        background: str | None = None,
        photo: bool = False,
    ) -> None:
        self._device = device
        self.views = Views.read(target, mask, weights, value_range)
        self.full = self.views
        """Those of the target itself, also where renders are smaller, see `at_size`."""
        self.size: tuple[int, int] | None = None
        """(h, w) of renders that are smaller than the target; None: they are not."""
        self._small: Views | None = None
        self.target = self.views.target  # (H, W, 3), packed if there are several views
        self.loss = loss_of(self.views, loss, device=device)
        if isinstance(encoder, str):
            for_network = for_network or encoders.uses_network(encoder)
            where = resolve_device(device, for_network=for_network)
            encoder = encoders.make(encoder, device=where)
        elif not isinstance(encoder, PatchEncoder):
            encoder = OwnEncoder(encoder, device=resolve_device(device, for_network=for_network))
        self.encoder = encoder_of(self.views, encoder)
        self._how: dict[str, Any] = {}
        self._blurred: dict[float, torch.Tensor] = {}  # tokens of the target, by the blur
        self._photo, self._auto = photo, photometric == "auto" or (photo and photometric is None)
        self.comparison: Comparison | None = None
        if photo or not (photometric is None and robust is None and background is None):
            self._how = {
                "light": "none" if photometric in (None, "auto") else photometric,
                "scale": robust if robust or not photo else "auto",
                "background": photo or background is not None,
            }
            self.comparison = self._compared_by(**self._how)
        self.target_tokens = self.encoder.compute(self.target[None])[0]  # (T, C)

    def _compared_by(self, **how: Any) -> Comparison:
        """A comparison with the present views and loss."""
        name = self.loss.spec
        loss_at = None if name is None else partial(loss_of, loss=name, device=self._device)
        return Comparison(self.views, self.loss, loss_at, **how)

    @property
    def adapts_light(self) -> bool:
        """Whether the images say which light is set aside."""
        return self._auto and getattr(self.loss, "of_places", True)

    @property
    def adapts_blur(self) -> bool:
        """Whether they say by how much the target is softer than renders."""
        return self._photo and getattr(self.loss, "of_places", True)

    def _copy(self) -> Evaluator:
        other = copy.copy(self)
        other.__dict__.pop("_compared", None)
        other._blurred = {}
        return other

    def comparing(self, state: Mapping[str, Any] | None) -> Evaluator:
        """The same that compares as a `comparison.state_dict` said; ValueError if it is none."""
        if state is None:
            return self
        other = self._copy()
        other.comparison = other._compared_by(**{**self._how, **checked(state)})
        other.target_tokens = other.encoder.compute(other.comparison.at().views.target[None])[0]
        return other

    def adjusted(self, images: object) -> Any:
        """Images as they are compared, in the user's values; images: as `FIDE.tell` takes them."""
        several = images[0] if self.views.listed and isinstance(images, list | tuple) else images
        n = len(several) if hasattr(several, "__len__") else 0
        batch = self.as_batch(n, images, np.zeros(n), None, Clipping().note)
        assert batch is not None  # images were given
        shown = batch
        if self.comparison is not None:
            shown = self.comparison.compare(shown).images
        parts = self.views.split(shown)
        return self.views.restored(parts if self.views.listed else parts[0])

    def light_of(self, image: Float32) -> Any:
        """Light in which an image (H, W, C) is compared; a list for a list of targets."""
        light = None if self.comparison is None else self.comparison.compare(image[None]).light
        return None if light is None else light[0] if self.views.listed else light[0][0]

    def mismatch(self, image: Float32, *, agreed: bool) -> str | None:
        """What explains most of the difference of an image (H, W, C) and the target, in words."""
        from fide_plugins.comparison.mismatch import explanation

        comparison = self._compared
        adjusts = (comparison.light != "none", comparison.scale is not None)
        views = comparison.leftovers(image)
        said = [explanation(*one, agreed=agreed, adjusts=adjusts) for one in views]
        return next((one for one in said if one is not None), None)

    def residual(self, image: Float32) -> list[Float32]:
        """What is left of each view, (H, W) in [0, 1]; image: (H, W, C), with its coverage."""
        return self._compared.residual(image)

    def shown(self, image: Float32) -> Float32:
        """An image (H, W, C) for people: in the light of the target, over it where it is free."""
        return image[..., :3] if self.comparison is None else self.comparison.shown(image)

    def retargeted(
        self, target: object, loss: str | Callable[..., object] | None = None
    ) -> Evaluator:
        """Another for a picture of the same size, with the same encoder and weights of pixels.

        loss: None for the same named loss; a user's own must be given again, since it may know the
            old picture.

        Raises ImageError, LossError or UnknownNameError.
        """
        views = self.views.retargeted(target)
        if loss is None and self.loss.spec is None:
            raise LossError(
                f"the loss {self.loss.name!r} was given as an object, which may be for the old "
                "target only; give the one for the new target: retarget(picture, loss=...)"
            )
        return self._with(views, loss or self.loss.spec)

    def at_size(self, size: tuple[int, int] | None) -> Evaluator:
        """The same for renders of (h, w) pixels, of a named loss; None: of the target's size.

        The target is reduced to that size.  Both are enlarged, so that all else keeps its shape.

        Raises LossError for a user's own loss, which knows the target's size only.
        """
        if self.loss.spec is None:
            raise LossError(
                f"renders smaller than the target need a named loss, not the object "
                f"{self.loss.name!r}"
            )
        small, views = None, self.full
        if size is not None:
            from fide_plugins.views.sizes import reduced, seen_at

            small = reduced(views, size)
            views = seen_at(views, small)
        other = self._with(views, self.loss.spec)
        other.full, other.size, other._small = self.full, size, small
        return other

    def _with(self, views: Views, loss: str | Callable[..., object] | None) -> Evaluator:
        other = self._copy()
        other.views, other.target = views, views.target
        other.full, other.size, other._small = views, None, None
        other.loss = loss_of(views, loss, device=self._device)
        other.encoder = encoder_of(views, self.encoder)
        if self.comparison is not None:
            options = {**self.comparison.options, "camera": 0.0}  # of other pixels
            other.comparison = other._compared_by(**options)
        shown = other.target if other.comparison is None else other.comparison.at().views.target
        other.target_tokens = other.encoder.compute(shown[None])[0]  # (T, C)
        return other

    @property
    def versions(self) -> dict[str, str | None]:
        """Of encoder and loss: they change whenever features or losses of an image do."""
        encoder, loss = self.encoder.version, self.loss.version
        return {"encoder": encoder, "loss": loss, "loss_name": self.loss.spec}

    def check_versions(self, saved: Mapping[str, object]) -> None:
        """Raise CheckpointError unless saved features and losses are of the present versions."""
        own = self.versions
        check(saved, dict.fromkeys(own, anything), {}, "versions")
        self.encoder.check_version(saved["encoder"])
        loss, same = saved["loss"], saved["loss_name"] == own["loss_name"]
        if loss is not None and same and loss != own["loss"]:
            raise CheckpointError(
                f"the saved state has values of the loss {loss}; the one here is {own['loss']}: "
                f"{checkpoint.VERSION_REMEDY}, or start again"
            )

    def as_batch(
        self, n: int, images: object, losses: object, features: object, on_clip: OnClip
    ) -> Float32 | None:
        """Images of n candidates, (n, H, W, 3), packed if there are several views, or None.

        With a fourth channel, the coverage, where renders have one and it is used.

        Raises LossError or FeaturesError where what is given contradicts itself, or ImageError.
        """
        if images is None and losses is None:
            raise LossError("tell needs images, losses, or both; got neither")
        if images is not None and features is not None:
            raise FeaturesError("tell takes images or their features, not both")
        if images is None:
            return None
        if self.comparison is None or not self.comparison.background:
            return self.colors(images, n, on_clip)
        if self._small is None:
            return with_coverage(self.views, images, n, on_clip)
        return self._enlarged(with_coverage(self._small, images, n, on_clip))

    def colors(self, images: object, n: int, on_clip: OnClip) -> Float32:
        """The same without coverage; raises ImageError."""
        if isinstance(images, list | tuple):
            images = without_coverage(images, self.views.listed)
        if self._small is None:
            return self.views.as_batch(images, n, on_clip)
        return self._enlarged(self._small.as_batch(images, n, on_clip))

    def _enlarged(self, batch: Float32) -> Float32:
        from fide_plugins.views.sizes import enlarged

        assert self._small is not None
        return enlarged(self._small, self.views, batch)

    def evaluate(
        self,
        n: int,
        batch: Float32 | None,
        losses: object = None,
        features: object = None,
        *,
        version: str | None = None,
        encode: bool = True,
    ) -> Evaluation:
        """Losses and tokens of n candidates with images (n, H, W, 3).

        losses: (n,), in place of the loss of the images.
        features: (n, T, C), in place of the tokens of the images; version: of their encoder.
        encode: whether tokens are needed at all.

        Raises LossError or FeaturesError.
        """
        told = batch
        if batch is None and losses is None:
            raise LossError("a loss of images needs images; got none")
        values, tokens, shown = None, None, batch
        if batch is not None and self.comparison is not None:
            compared = self.comparison.compare(batch)
            batch, shown, values = batch[..., :3], compared.images, compared.losses
        if losses is not None:
            values = as_losses(losses, n)
        elif values is None and batch is not None:
            values = self.loss.compute(batch)
        if encode and shown is not None:
            tokens = self.encoder.compute(shown)
        if features is not None:
            shape = (n, *self.target_tokens.shape)
            taken = as_features(features, shape, self.encoder, version=version)
            tokens = taken if encode else None
        assert values is not None
        return Evaluation(values, batch, tokens, told)

    def at_blur(self, results: Evaluation, blur: float, *, encode: bool = True) -> Evaluation:
        """The same results with tokens, and losses for the search, of images at a blur.

        blur: standard deviation in pixels; 0: sharp.  Those without images stay as they are.
        """
        batch = results.batch
        if batch is None or (results.blur == blur and (results.tokens is not None or not encode)):
            return results
        if not blur:
            again = self.evaluate(len(batch), batch, results.losses, encode=encode)
            return replace(results, tokens=again.tokens, blur=0.0, told=None)
        compared = self._compared.compare(batch, blur)
        tokens = self.encoder.compute(compared.images) if encode else None
        return replace(results, tokens=tokens, blur=blur, told=compared.losses)

    def tokens_at(self, blur: float) -> torch.Tensor:
        """Tokens (T, C) of the target at a blur, in pixels."""
        if not blur:
            return self.target_tokens
        if blur not in self._blurred:
            shown = self._compared.at(blur).views.target
            self._blurred[blur] = self.encoder.compute(shown[None])[0]
        return self._blurred[blur]

    @cached_property
    def _compared(self) -> Comparison:
        """A comparison, also where renders are compared as they are."""
        return self._compared_by() if self.comparison is None else self.comparison
