"""Quantiles and rank statistics of a few runs; no means, since losses have heavy tails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats

from fide_lab.compare.results import Curve
from fide_plugins.types import Float64

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
_POINTS = 120  # points of a band, more than the eye can distinguish
_HUGE = 1e300


@dataclass(frozen=True, eq=False)
class Bands:
    """Quantiles over runs of the best loss so far; x: (n,); values: (5, n), by `QUANTILES`."""

    x: Float64
    values: Float64


@dataclass(frozen=True)
class Paired:
    """Paired comparison of the runs of two configurations.

    n: number of pairs; worse: number of pairs in which the first has the higher loss.
    p: p-value of the two-sided Wilcoxon signed-rank test, exact for few pairs.  Pairs without a
        difference have ranks, too (Pratt 1959).
    ratio: median of the ratios of losses, without pairs of two infinite ones; may be infinite.
        NaN if there is no such pair, or a loss is zero or negative.
    adjusted: p adjusted for multiple tests.
    """

    n: int
    worse: int
    p: float
    ratio: float
    adjusted: float = np.nan

    @property
    def smallest_p(self) -> float:
        """The smallest p-value that n pairs can give."""
        return min(1.0, 2.0 ** (1 - self.n))


def quantiles(values: npt.ArrayLike, q: Sequence[float] = QUANTILES) -> Float64:
    """Interpolated quantiles along the first axis; infinity counts as the highest value.

    >>> quantiles([1.0, 2.0, np.inf], [0.5, 1.0])
    array([ 2., inf])
    """
    array = np.asarray(values, np.float64)
    found = np.quantile(np.where(np.isposinf(array), _HUGE, array), q, axis=0)
    return np.where(found > _HUGE / 1e6, np.inf, found)


def bands(curves: Sequence[Curve], axis: str, failed: int = 0) -> Bands:
    """Quantiles of `curves` and of `failed` runs at geometrically spaced points along an axis.

    A failed run, and one that never had a finite loss, counts as infinite.  The band starts where
    all others have a loss, and ends at the end of the median run of `curves`.  A run that has
    ended keeps its last loss.
    """
    begun = [curve for curve in curves if len(curve.loss)]
    if not begun:
        return Bands(np.zeros(0), np.zeros((len(QUANTILES), 0)))
    begin = max(float(curve.at[axis][0]) for curve in begun)
    end = float(np.median([curve.ends[axis] for curve in curves]))
    begin, end = max(begin, end * 1e-6), max(begin, end)
    x = np.geomspace(begin, end, _POINTS) if end > begin else np.array([begin])
    x = np.unique(np.floor(x)) if axis != "seconds" else x
    x[0], x[-1] = begin, end  # exact, without rounding errors
    never = np.full((len(curves) - len(begun) + failed, len(x)), np.inf)
    return Bands(x, quantiles([*(curve.value(axis, x) for curve in begun), *never]))


def paired(losses: npt.ArrayLike, others: npt.ArrayLike) -> Paired:
    """Compare `losses` (n,) with `others` (n,) pair by pair.

    The test ranks differences of logarithms, so that 0.001 against 0.002 counts as much as 0.1
    against 0.2.  If a loss is negative, it ranks differences of losses.  A loss of zero is better
    than any other, and an infinite one worse, by more than any other difference; two of a kind are
    equal.
    """
    values = np.array([losses, others], np.float64)
    a, b = np.where(np.isfinite(values), values, np.inf)
    least = min(a.min(), b.min())
    with np.errstate(divide="ignore"):  # of 0: minus infinity
        differences = _differences(a, b) if least < 0 else _differences(np.log(a), np.log(b))
    worse = int((differences > 0).sum())
    told = np.isfinite(a) | np.isfinite(b)
    ratio = float(np.median(a[told] / b[told])) if least > 0 and told.any() else np.nan
    p = 1.0
    if differences.any():  # SciPy leaves out zeros unless it is told otherwise
        p = float(stats.wilcoxon(differences, zero_method="pratt").pvalue)
    return Paired(len(a), worse, p, ratio)


def adjusted(p: Sequence[float]) -> list[float]:
    """p-values adjusted for multiple tests, by Benjamini and Hochberg's false discovery rate."""
    return stats.false_discovery_control(p).tolist() if p else []


def _differences(a: Float64, b: Float64) -> Float64:
    """Differences a - b (n,), finite: an infinite difference becomes larger than all others."""
    with np.errstate(invalid="ignore"):  # infinity minus infinity
        found = np.where(a == b, 0.0, a - b)
    largest = np.abs(found[np.isfinite(found)]).max(initial=0.0)
    return np.where(np.isinf(found), np.copysign(2.0 * largest + 1.0, found), found)
