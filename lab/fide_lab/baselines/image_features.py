"""Baselines that learn from features of images, and not only from their losses."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_lab.baselines.base import Baseline
from fide_lab.baselines.images_needed import needed_images, needed_target
from fide_plugins.errors import OptionError
from fide_plugins.runtime.schema import Sides
from fide_plugins.runtime.threads import one_at_a_time
from fide_plugins.types import Float32
from fide_plugins.validation.points import whole_number

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["ImageBased"]


class ImageBased(Baseline):
    """A baseline to which images must be told; losses beside them are optional, as always.

    target: image to fit, required.
    encoder: name in `fide_plugins.encoders`.
    channels: number of leading channels of its tokens that are used; None: all.  The first three of
        "dense" are the mean colors of (at most) 14 x 14 patches.

    Raises OptionError, ImageError without a target (ValueErrors), or what
    `fide_plugins.encoders.make` raises.
    """

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        encoder: str = "dense",
        channels: int | None = None,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, **options)
        image = needed_target(self.name, self.target)  # (H, W, 3)
        from fide_plugins import encoders  # PyTorch takes a second
        from fide_plugins.runtime.devices import resolve_device

        self.encoder = encoder
        where = resolve_device(self.device, for_network=encoders.uses_network(encoder))
        self._encoder = encoders.make(encoder, device=where)
        self._tokens, most = self._encoder.shape(*image.shape[:2])
        if channels is not None and whole_number("channels", channels, 1) > most:
            raise OptionError(f"channels must be at most {most} for {encoder}, not {channels}")
        self.channels = channels
        self.target_features: Float32 = self._encode(image[None])[0]
        """Features (f,) of the target."""

    @property
    def pretrained(self) -> tuple[str, str] | None:
        """Name of the encoder and digest of its pretrained weights; None if it has none."""
        digest = self._encoder.weights_digest
        return None if digest is None else (self.encoder, digest)

    @cached_property
    def target_tokens(self) -> Tensor:
        """Tokens (T, C) of the target."""
        return self.tokens_of(self.target_features[None])[0]

    def tokens_of(self, features: Float32) -> Tensor:
        """Tokens (n, T, C) from features (n, f), f = T C."""
        import torch  # takes a second

        return torch.from_numpy(features).reshape(len(features), self._tokens, -1)

    def _encode(self, batch: Float32 | None) -> Float32:
        images = needed_images(self.name, batch)
        tokens = self._encoder.compute(images)[..., : self.channels]  # (n, T, C)
        features: Float32 = tokens.flatten(1).cpu().numpy().astype(np.float32)
        return features

    @one_at_a_time
    def state_dict(self) -> dict[str, Any]:
        """As that of any baseline, and the version of the encoder."""
        return {**super().state_dict(), "encoder": self._encoder.version}

    @one_at_a_time
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where `state_dict` was called; ValueError if `state` is impossible.

        Raises CheckpointError (a ValueError) if the features are of another encoder, or of other
        weights.
        """
        if isinstance(state, Mapping) and "encoder" in state:  # one that is older has none
            self._encoder.check_version(state["encoder"])
            state = {name: value for name, value in state.items() if name != "encoder"}
        super().load_state_dict(state)

    def _sides(self) -> Sides:
        return super()._sides() | {"f": len(self.target_features)}

    def _own_settings(self) -> dict[str, Any]:
        own = {"encoder": self.encoder, "channels": self.channels}
        return {**super()._own_settings(), **own}
