"""How much a picture is like those that were learned.

The Mahalanobis distance of its features from those of training renders (Lee et al. 2018,
arXiv:1807.03888), compared with the distances of held-out renders.  Of a few of these the largest
is hardly a bound, so the prediction interval of a further one counts as well, with normal
logarithms.  Of fewer than 20 even their spread is a guess: then training renders say how much
distances vary, too, by those of each fifth from the other four.
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
_FOLDS = 5
_FEW = 20  # held-out renders: with so many, a standard deviation is known to a sixth (1 / sqrt(2n))


@dataclass(frozen=True)
class Familiarity:
    """Mean (F,) and precision (F, F) of features, and the distance that is still familiar."""

    mean: Float64
    precision: Float64
    threshold: float

    @classmethod
    def of(cls, training: Float64, held_out: Float64) -> Self:
        """Familiarity of features (n, F) of training renders, judged on others (m, F)."""
        mean, precision = _moments(training)
        distances = cls(mean, precision, 0.0).distances(held_out)
        others = _across(training) if len(held_out) < _FEW else np.empty(0)
        return cls(mean, precision, _MARGIN * _usual(distances, others))

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


def _across(training: Float64) -> Float64:
    """Distance (n,) of each of n renders from those of the other folds."""
    fold = np.arange(len(training)) % _FOLDS
    found = np.empty(len(training))
    for k in range(_FOLDS):
        others = Familiarity(*_moments(training[fold != k]), 0.0)
        found[fold == k] = others.distances(training[fold == k])
    return found


def _moments(features: Float64) -> tuple[Float64, Float64]:
    """Mean (F,) and precision (F, F) of features (n, F)."""
    covariance = np.atleast_2d(np.cov(features, rowvar=False))
    ridge = _RIDGE * max(float(np.trace(covariance)) / features.shape[1], 1e-12)
    inverse = np.linalg.inv(covariance + ridge * np.eye(features.shape[1]))
    return features.mean(axis=0), np.asarray(inverse, np.float64)


def _usual(distances: Float64, others: Float64) -> float:
    """Distance that hardly any further render exceeds, by those of some (m,).

    others: (n,), distances that vary as these do, of another size perhaps.
    """
    seen = float(np.quantile(distances, _QUANTILE))
    samples = [_logs(some) for some in (distances, others) if len(some) > 1]
    freedom = sum(len(logs) - 1 for logs in samples)
    if freedom == 0 or seen == 0:
        return seen
    variance = sum(float(np.square(logs - logs.mean()).sum()) for logs in samples) / freedom
    error = np.sqrt(variance * (1 + 1 / len(distances)))
    return max(seen, float(np.exp(_logs(distances).mean() + t.ppf(_QUANTILE, freedom) * error)))


def _logs(distances: Float64) -> Float64:
    """Logarithms (m,), bounded for distances that are 0."""
    largest = max(float(distances.max()), 1e-300)
    return np.asarray(np.log(np.maximum(distances, 1e-3 * largest)), np.float64)
