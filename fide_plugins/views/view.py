"""Target and weights of one view."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fide_plugins.types import Float32, Float64, Mask
from fide_plugins.views.weights import hidden_by

__all__ = ["View"]

_SHADES = 8  # steps of a channel of the color that hidden pixels get


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

        So its own pixels there influence no tokens, and no losses that have a name.  The color is
        rounded, since remembered tokens are compared with those of the next target (`retarget`),
        which mostly has the same rounded one.
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
        return apart if self.weights is None else apart * (self._roots / self.mean_weight**0.5)

    def squared_error(self, image: Float32) -> float:
        """Weighted mean of the squared difference of an image (H, W, 3) from the target."""
        squared = np.square(image - self.target, dtype=np.float64)
        if self.weights is None:
            return float(squared.mean())
        return float(np.average(squared.mean(axis=-1), weights=self.weights))

    @property
    def counted(self) -> int:
        """How many pixels count at all."""
        height, width = self.size
        return height * width if self.weights is None else int(np.count_nonzero(self.weights))

    def largest_errors(self, image: Float32) -> Float32:
        """(H, W), largest difference of a color from the target; 0 where a pixel does not count."""
        missed: Float32 = np.abs(image - self.target).max(axis=-1)
        return missed if self.weights is None else np.where(self.weights > 0, missed, 0)
