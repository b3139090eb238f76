"""Target and weights of one view."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fide_plugins.types import Float32, Float64, Mask
from fide_plugins.views.weights import hidden_by

__all__ = ["DIGITS", "View"]

DIGITS = 5e-7  # by which values in [0, 1] may differ in single precision
_ALL = slice(None)
_ROWS = 32
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

    def difference(self, image: Float32, other: Float32, rows: slice = _ALL) -> Float64:
        """Difference of two images, (H, W, 3), whose mean square is the weighted one.

        rows: of these alone.
        """
        apart = np.subtract(image[rows], other[rows], dtype=np.float64)
        if self.weights is None:
            return apart
        apart *= self._roots[rows] / self.mean_weight**0.5
        return apart

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

    @cached_property
    def contrast(self) -> float:
        """Range of the target's values where they count, in the color in which it is largest."""
        seen = self.target[... if self.hidden is None else ~self.hidden].reshape(-1, 3)
        return float(np.ptp(seen, axis=0).max())

    def is_rounded(self, levels: float) -> bool:
        """Whether all values of the target that count are whole multiples of 1 / levels."""
        rows = slice(None, None, max(1, len(self.target) // _ROWS))
        for some in (rows, _ALL):  # a few rows tell mostly
            steps = self.target[some].astype(np.float64) * levels
            whole = abs(steps - np.round(steps)) <= levels * DIGITS
            if not (whole if self.hidden is None else whole[~self.hidden[some]]).all():
                return False
        return True

    def errors(self, image: Float32, rounding: float, rows: slice = _ALL) -> Float32:
        """(H, W, 3), how much farther than `rounding` an image is from the target; 0: no farther.

        rows: of these alone.
        """
        errors: Float32 = np.abs(image[rows] - self.target[rows])
        if rounding:
            errors = np.maximum(errors - np.float32(rounding + DIGITS), 0, dtype=np.float32)
        return errors

    def share_of_mean(self, values: Float32, rows: slice = _ALL) -> float:
        """What the values (h, W, 3) of these rows contribute to the weighted mean of all."""
        height, width = self.size
        if self.weights is None:
            return float(values.sum(dtype=np.float64)) / (3 * height * width)
        sums = float((values.mean(axis=-1, dtype=np.float64) * self.weights[rows]).sum())
        return sums / (height * width * self.mean_weight)
