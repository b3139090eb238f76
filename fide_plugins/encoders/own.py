"""A user's own encoder: any callable of a batch.

    def encode(images):            # float32 (n, H, W, 3) in [0, 1], a copy
        return features            # (n, T, C) or (n, C), floating point, finite; array or tensor

The features of an image must not depend on the rest of its batch, and T and C only on the image
size.  Attributes of the callable that are used where they exist: `version` (a string that changes
whenever features do), `channel_subsets` (see `PatchEncoder`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.errors import FeaturesError
from fide_plugins.runtime.registry import name_of, tried_on
from fide_plugins.runtime.threads import user_threads
from fide_plugins.types import Float32


class OwnEncoder(PatchEncoder):
    """A callable as an encoder, with checks of what it returns.

    name: that of the callable; under which it is registered, if it is.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        *,
        name: str | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        super().__init__(device=device)
        self.name = name_of(function) if name is None else name
        self.version = str(getattr(function, "version", f"own:{self.name}"))
        self.channel_subsets = tuple(getattr(function, "channel_subsets", (None,)))
        self._function = function
        self._shapes: dict[tuple[int, ...], tuple[int, ...]] = {}  # (H, W): (T, C)

    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(T, C) for images of that size, by a black one."""
        if (height, width) not in self._shapes:
            self.compute(np.zeros((1, height, width, 3), np.float32))
        tokens, channels = self._shapes[height, width]
        return tokens, channels

    @torch.no_grad()
    def compute(self, batch: Float32) -> torch.Tensor:
        """Tokens (n, T, C) of a canonical batch; raises FeaturesError."""
        with user_threads:
            made = self._function(batch.copy())
        try:
            tokens = made if isinstance(made, torch.Tensor) else torch.from_numpy(np.asarray(made))
        except (TypeError, ValueError) as error:
            raise self._refused(type(made).__name__) from error
        tokens = tokens[:, None] if tokens.ndim == 2 else tokens  # one token
        shape = tuple(tokens.shape[1:])
        if tokens.ndim != 3 or len(tokens) != len(batch) or 0 in shape:
            raise self._refused(f"the shape {tuple(np.shape(made))} for n = {len(batch)}")
        if not tokens.is_floating_point() or not torch.isfinite(tokens).all():
            raise self._refused(f"{tokens.dtype} with other values")
        known = self._shapes.setdefault(batch.shape[1:3], shape)
        if shape != known:
            raise self._refused(f"(T, C) = {shape}, and {known} before for images of this size")
        return tokens.detach().float().clone().to(self.device)  # its array may be used again

    def _refused(self, made: str) -> FeaturesError:
        return FeaturesError(
            "an encoder takes images, float32 (n, H, W, 3) in [0, 1], and returns finite floats, "
            f"(n, T, C) or (n, C); {self.name!r} returned {made}"
        )

    def _encode(self, images: torch.Tensor) -> torch.Tensor:
        raise AssertionError("`compute` calls the function")


def check_encoder(encoder: OwnEncoder, target: Float32) -> None:
    """Try a user's own encoder on the target (H, W, 3) and its negative; raises FeaturesError."""
    what = f"the encoder {encoder.name!r}"
    tried_on(target, lambda one: encoder.compute(one).cpu().numpy(), what, FeaturesError)
