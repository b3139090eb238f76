"""Target and weights of one view."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fide_plugins.types import Float32, Float64, Mask

__all__ = ["DIGITS", "View", "hidden_by"]

DIGITS = 5e-7  # by which values in [0, 1] may differ in single precision
_SHADES = 8  # steps of a channel of the color that hidden pixels get


def hidden_by(weights: Float32 | None) -> Mask | None:
    """Pixels (H, W) of weight 0; None if there are none."""
    hidden = None if weights is None else weights == 0
    return None if hidden is None or not hidden.any() else hidden


@dataclass(frozen=True, eq=False)
class View:
    """One view.

    target: (H, W, 3).
    weights: (H, W) in [0, 1], the largest 1; None: all are.
    """

    target: Float32
    weights: Float32 | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        return self.target.shape[0], self.target.shape[1]

    @cached_property
    def mean_weight(self) -> float:
        """Mean of the weights."""
        return 1.0 if self.weights is None else float(self.weights.mean(dtype=np.float64))

    @cached_property
    def hidden(self) -> Mask | None:
        """(H, W), pixels of weight 0, where a render may have any values; None: all count."""
        return hidden_by(self.weights)

    @cached_property
    def _roots(self) -> Float32:
        assert self.weights is not None
        roots: Float32 = np.sqrt(self.weights)[..., None]
        return roots

    @cached_property
    def filled(self) -> Float32:
        """Target whose hidden pixels have the mean color of all others, (H, W, 3).

        The color is rounded, since remembered tokens are compared with those of the next target
        (`retarget`), which mostly has the same rounded one.
        """
        if self.hidden is None:
            return self.target
        filled = self.target.copy()
        mean = self.target[~self.hidden].mean(axis=0, dtype=np.float64)
        filled[self.hidden] = np.round(mean * _SHADES) / _SHADES
        filled.flags.writeable = False
        return filled

    def shown(self, batch: Float32) -> Float32:
        """What encoder and named loss see of renders (n, H, W, 3): `blended` with `filled`."""
        return self._blended(batch, self.filled)

    def blended(self, batch: Float32) -> Float32:
        """What a user's own loss, which may know the target, sees: x' = t + sqrt(w) (x - t)."""
        return self._blended(batch, self.target)

    def _blended(self, batch: Float32, t: Float32) -> Float32:
        if self.weights is None:
            return batch
        roots = self._roots
        with np.errstate(under="ignore"):  # a tiny difference times a weight
            blended: Float32 = np.where(roots == 1, batch, t + roots * (batch - t))
        return blended

    def difference(self, image: Float32, other: Float32) -> Float64:
        """Difference of two images, (H, W, 3), whose mean square is the weighted one."""
        apart = np.subtract(image, other, dtype=np.float64)
        if self.weights is not None:
            apart *= self._roots / self.mean_weight**0.5
        return apart

    @property
    def counted(self) -> int:
        """How many pixels count at all."""
        return int(np.prod(self.size) if self.weights is None else np.count_nonzero(self.weights))

    @cached_property
    def contrast(self) -> float:
        """Range of the target's values where they count, in the color in which it is largest."""
        return float(np.ptp(self._seen(self.target), axis=0).max())

    def is_rounded(self, levels: float) -> bool:
        """Whether all values of the target that count are whole multiples of 1 / levels."""
        steps = self._seen(self.target).astype(np.float64) * levels
        return bool((abs(steps - np.round(steps)) <= levels * DIGITS).all())

    def _seen(self, image: Float32) -> Float32:
        """Pixels (m, 3) that count."""
        return image[... if self.hidden is None else ~self.hidden].reshape(-1, 3)
