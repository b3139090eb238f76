"""What a user tells of candidates becomes losses and features (Algorithm 1, lines 7 and 9)."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import torch

from fide_plugins import encoders, losses as named_losses
from fide_plugins.comparison.comparison import Comparison, checked
from fide_plugins.comparison.coverage import with_coverage, without_coverage
from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.encoders.own import OwnEncoder, check_encoder
from fide_plugins.errors import CheckpointError, LossError, OptionError
from fide_plugins.losses.base import (
    CallableLoss,
    ImageLoss,
    LossOfTarget,
    as_losses,
    check_loss,
    loss_not_stored,
)
from fide_plugins.options import Options
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.devices import resolve_device
from fide_plugins.runtime.registry import name_of
from fide_plugins.runtime.schema import anything, check
from fide_plugins.runtime.threads import user_threads
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.values import Clipping, OnClip, warn_clipped
from fide_plugins.views import View, Views

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
        encoder only if it is a network, or if the proposer is one.
    options: how images are compared; None: as they are by default.

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
        options: Options | None = None,
    ) -> None:
        o = options or Options()
        for_network, photo = o.proposer == "diffusion", o.photo
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
        self._photo = photo
        self._compared = self._compared_by()
        """A comparison, also where renders are compared as they are."""
        self._auto = o.photometric == "auto" or (photo and o.photometric is None)
        self.comparison: Comparison | None = None
        if photo or o.photometric or o.robust or o.background:
            self._how = {
                "light": "none" if o.photometric in (None, "auto") else o.photometric,
                "scale": o.robust if o.robust or not photo else "auto",
                "background": photo or o.background is not None,
            }
            self.comparison = self._compared = self._compared_by(**self._how)
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

    def comparing(self, state: Mapping[str, Any] | None) -> Evaluator:
        """The same that compares as a `comparison.state_dict` said; ValueError if it is none."""
        if state is None:
            return self
        other, how = copy.copy(self), {**self._how, **checked(state, self.views)}
        other._blurred = {}
        other.comparison = other._compared = other._compared_by(**how)
        other.target_tokens = other.encoder.compute(other.comparison.at().views.target[None])[0]
        return other

    def adjusted(self, images: object) -> Any:
        """Images as they are compared, in the user's values; images: as `FIDE.tell` takes them."""
        several = images[0] if self.views.listed and isinstance(images, list | tuple) else images
        n = len(several) if hasattr(several, "__len__") else 0
        batch = self.as_batch(n, images, np.zeros(n), Clipping().note)
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
        other = copy.copy(self)
        other.views, other.target = views, views.target
        other.full, other.size, other._small = views, None, None
        other.loss = loss_of(views, loss, device=self._device)
        other.encoder = encoder_of(views, self.encoder)
        other._blurred, other._compared = {}, other._compared_by()
        if self.comparison is not None:
            options = {**self.comparison.options, "camera": 0.0}  # of other pixels
            other.comparison = other._compared = other._compared_by(**options)
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

    def as_batch(self, n: int, images: object, losses: object, on_clip: OnClip) -> Float32 | None:
        """Images of n candidates, (n, H, W, 3), packed if there are several views, or None.

        With a fourth channel, the coverage, where renders have one and it is used.

        Raises LossError if neither images nor losses are given, or ImageError.
        """
        if images is None and losses is None:
            raise LossError("tell needs images, losses, or both; got neither")
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
        features: torch.Tensor | None = None,
        *,
        encode: bool = True,
        note: bool = False,
    ) -> Evaluation:
        """Losses and tokens of n candidates with images (n, H, W, 3).

        losses: (n,), in place of the loss of the images.
        features: (n, T, C), tokens where there are no images.
        encode: whether tokens are needed at all.
        note: whether the comparison notes what no candidate removes, see `Comparison.floor`.

        Raises LossError.
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
        if encode and features is not None:
            tokens = features.to(self.encoder.device)
        assert values is not None
        if note and shown is not None and self.comparison is not None:
            self.comparison.note(shown)
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


# -- loss and encoder of several views, or of the pixels that count --------------------------------


def loss_of(
    views: Views,
    loss: str | Callable[..., object] | None,
    *,
    device: str | torch.device | None = None,
) -> ImageLoss:
    """Loss from a name, None for "mse", a callable, or a loss of one view that was made.

    A user's own is tried on the target first.  Raises as `losses.resolve`, and LossError for a made
    loss where there are several views.
    """
    if isinstance(loss, LossOfViews):
        return loss
    if views.plain:
        made = named_losses.resolve(loss, views.target, device=device)
        if isinstance(made, CallableLoss) and made is not loss and loss is not loss_not_stored:
            check_loss(made, views.target)
        return made
    if loss is None or isinstance(loss, str):
        name = loss or "mse"
        return LossOfViews(views, [_of_view(name, view, device) for view in views.views], name)
    if isinstance(loss, LossOfTarget | CallableLoss):
        if views.listed:
            raise LossError(
                f"the loss {loss.name!r} was made for one target, and there are "
                f"{len(views.views)} views; pass its name, or a function of a list of batches"
            )
        made = named_losses.resolve(loss, views.target)
        spec = made.spec
        if spec is not None:  # as a checkpoint makes it again
            made = _of_view(spec, views.views[0], device)
        return LossOfViews(views, [made], spec)
    if not callable(loss):
        return named_losses.resolve(loss, views.target)  # raises
    several = CallableOfViews(views, loss)
    if loss is not loss_not_stored:
        check_loss(several, views.target)
    return several


def _of_view(name: str, view: View, device: str | torch.device | None) -> ImageLoss:
    """Loss of one view: with its weights, if it takes them."""
    if view.weights is not None and named_losses.takes_weights(name):
        return named_losses.make(name, view.filled, weights=view.weights)
    made = named_losses.resolve(name, view.filled, device=device)
    if isinstance(made, CallableLoss):
        check_loss(made, view.filled)
    return made


class LossOfViews:
    """Mean of the views' losses, each divided by the mean of its weights.

    each: loss of each view, in order, of `View.filled`.  One that knows the weights is not divided.
    spec: its name; None: a user's own, which was made for the target as it was given.
    """

    def __init__(self, views: Views, each: list[ImageLoss], spec: str | None) -> None:
        self.views, self._each, self.spec = views, each, spec
        self.name, version = each[0].name, each[0].version
        self.version = None if version is None else version + views.version
        self.of_places = all(getattr(one, "of_places", True) for one in each)

    def __call__(self, images: object) -> Float64:
        """Losses (n,) of images, as `FIDE.tell` takes them."""
        return self.compute(self.views.as_batch(images, None, warn_clipped))

    def compute(self, batch: Float32) -> Float64:
        """Losses (n,) of packed renders, without further checks."""
        parts = zip(self.views.views, self._each, self.views.split(batch), strict=True)
        mean: Float64 = np.mean([self._of_view(*part) for part in parts], axis=0)  # of (n,) each
        return mean

    def _of_view(self, view: View, loss: ImageLoss, part: Float32) -> Float64:
        knows_weights = getattr(loss, "weights", None) is not None
        if view.weights is None or (getattr(loss, "weighs_pixels", False) and knows_weights):
            return loss.compute(part)
        shown = view.blended(part) if self.spec is None else view.shown(part)
        values: Float64 = loss.compute(shown) / view.mean_weight
        return values


class CallableOfViews(LossOfViews):
    """A user's function of what is seen of the views, with checks of its values."""

    version = None
    spec = None

    def __init__(self, views: Views, function: Callable[..., object]) -> None:
        self.views, self.name, self._function = views, name_of(function), function

    @user_threads
    def compute(self, batch: Float32) -> Float64:
        """Losses (n,) of packed renders; the function gets copies, which it may modify."""
        pairs = zip(self.views.views, self.views.split(batch), strict=True)
        shown = [view.blended(part).copy() for view, part in pairs]
        values = self._function(shown if self.views.listed else shown[0])
        return as_losses(values, len(batch), f"the loss {self.name!r}")


# -- the encoder -----------------------------------------------------------------------------------


def encoder_of(views: Views, encoder: PatchEncoder) -> PatchEncoder:
    """The encoder of views; the encoder itself for one view without weights.

    A user's own is tried on the targets; raises FeaturesError.
    """
    base = encoder.base if isinstance(encoder, EncoderOfViews) else encoder
    for view in views.views:
        if isinstance(base, OwnEncoder):
            check_encoder(base, view.target)
    return base if views.plain else EncoderOfViews(views, base)


class EncoderOfViews(PatchEncoder):
    """Joins the tokens of all views along T: (n, T_1 + T_2 + ..., C).

    base: encodes the pictures of each view, with the target's pixels where they do not count.

    Raises OptionError if the encoder has another C for one of the views.
    """

    def __init__(self, views: Views, base: PatchEncoder) -> None:
        self.views, self.base = views, base
        self.version = base.version + views.version
        for name in ("name", "uses_network", "weights_digest", "channel_subsets", "device"):
            setattr(self, name, getattr(base, name))
        shapes = [base.shape(*view.size) for view in views.views]
        if len({channels for _, channels in shapes}) > 1:
            raise OptionError(
                f"the encoder {base.name!r} gives tokens of different lengths C for the views, "
                f"(T, C) = {shapes}; take one whose C does not depend on the size"
            )
        self._shape = sum(tokens for tokens, _ in shapes), shapes[0][1]

    def __call__(self, images: object) -> torch.Tensor:
        """Tokens (n, T, C) of renders, as `FIDE.tell` takes them; raises ImageError."""
        return self.compute(self.views.as_batch(images, None, lambda message: None))

    def compute(self, batch: Float32) -> torch.Tensor:
        """Tokens (n, T, C) of packed renders (n, P, 1, 3), without further checks."""
        pairs = zip(self.views.views, self.views.split(batch), strict=True)
        return torch.cat([self.base.compute(view.shown(part)) for view, part in pairs], dim=1)

    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(T, C) of all views together, whose sizes are known."""
        return self._shape

    def _encode(self, images: torch.Tensor) -> torch.Tensor:
        raise AssertionError("`compute` encodes each view by the base")
