"""How much a picture is like those that were learned.

The Mahalanobis distance of its features from those of training renders (Lee et al. 2018,
arXiv:1807.03888), compared with the distances of held-out renders.  Of a few of these the largest
is hardly a bound, so the prediction interval of a further one counts as well, with normal
logarithms.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
from scipy.stats import t

from fide_plugins.types import Float64

__all__ = ["Familiarity"]

_QUANTILE = 0.995  # of distances of renders: these are familiar
_MARGIN = 1.25  # a picture is not a render
_RIDGE = 1e-3  # of the mean variance


@dataclass(frozen=True)
class Familiarity:
    """Mean (F,) and precision (F, F) of features, and the distance that is still familiar."""

    mean: Float64
    precision: Float64
    threshold: float

    @classmethod
    def of(cls, training: Float64, held_out: Float64) -> Self:
        """Familiarity of features (n, F) of training renders, judged on others (m, F)."""
        mean = training.mean(axis=0)
        covariance = np.atleast_2d(np.cov(training, rowvar=False))
        ridge = _RIDGE * max(float(np.trace(covariance)) / len(mean), 1e-12)
        precision = _inverse(covariance + ridge * np.eye(len(mean)))
        draft = cls(mean, precision, 0.0)
        return cls(mean, precision, _MARGIN * _usual(draft.distances(held_out)))

    def distances(self, features: Float64) -> Float64:
        """Mahalanobis distances (n,) of features (n, F)."""
        centered = features - self.mean
        squares = np.einsum("nf,fg,ng->n", centered, self.precision, centered)
        return np.asarray(np.sqrt(np.maximum(squares, 0.0)), np.float64)

    def knows(self, features: Float64) -> bool:
        """Whether features (F,) are like those of renders."""
        return bool(self.distances(features[None])[0] <= self.threshold)

    def state_dict(self) -> dict[str, Any]:
        """All of it."""
        return asdict(self)

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Self:
        """What `state_dict` gave."""
        return cls(state["mean"], state["precision"], state["threshold"])


def _usual(distances: Float64) -> float:
    """Distance that hardly any further render exceeds, by those of some (m,)."""
    seen = float(np.quantile(distances, _QUANTILE))
    if len(distances) < 2 or seen == 0:
        return seen
    logs = np.log(np.maximum(distances, 1e-3 * seen))
    error = float(logs.std(ddof=1)) * np.sqrt(1 + 1 / len(logs))
    return max(seen, float(np.exp(logs.mean() + t.ppf(_QUANTILE, len(logs) - 1) * error)))


def _inverse(matrix: Float64) -> Float64:
    return np.asarray(np.linalg.inv(matrix), np.float64)
