"""Integers and choices in a search by a Gaussian: CMA-ES with margin.

A search in R^d stands still on an integer once its standard deviation is much smaller than a cell:
every sample is then the same integer, and nothing says that another one is better.  CMA-ES with
margin (Hamano, Saito, Nomura and Shirakawa 2022, GECCO, arXiv:2205.13482) moves the mean and
stretches the samples after each generation, just so that the probability of leaving the cell of
the mean stays above alpha.  Covariance, step size and paths stay as they are.

Notation
--------
=====  ======  ===================================================================================
m      (d,)    mean
s      (d,)    standard deviations of samples, A sigma sqrt(diag C)
A      (d,)    how much samples are stretched about the mean, 1 at the beginning, on axes with
               cells; v = m + A (z - m) is rendered, z is what CMA-ES learns from
l, u   (d,)    where the cell of the mean begins and ends; -inf, inf for the first and the last
alpha  ()      smallest probability; the paper's is 1 / (d k) with k candidates a generation
q(p)           quantile of the normal distribution; q(1 - p) = sqrt(chi2_ppf(1 - 2 p)) of the paper
=====  ======  ===================================================================================

The two rules of the paper, for an axis with cells:

- *first or last cell* (and so every axis of two cells; "margin for binary variables"): the mean is
  not farther than q(1 - alpha) s from the only edge, so that the other side has alpha at least.
- *a cell with neighbors on both sides* ("margin for integer variables"): both sides get at least
  alpha / 2, and the three probabilities are brought back to a sum of 1 in proportion to what they
  have above alpha / 2; m and A follow from the two of the sides.

A choice of K > 2 values has K axes, and the largest coordinate decides.  Between the value b of the
largest mean and another value j that is an axis with one edge: z_b - z_j is Gaussian and decides at
zero.  So the first rule is applied to each such pair: no mean is farther below that of b than
q(1 - alpha) times the standard deviation of the difference.  Besides, only differences count, and
the means of a block, which would wander off together, are centered.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr, ndtri

from fide_plugins.types import Float64

__all__ = ["correct_choice", "correct_steps", "default_alpha"]

_SMALLEST, _LARGEST = 1e-10, 0.5 - 1e-10  # probabilities of one side
_CENTER = 0.5  # of the means of a block


def default_alpha(dim: int, popsize: int) -> float:
    """Smallest probability 1 / (d k) (Hamano et al. 2022)."""
    return 1 / (dim * popsize)


def correct_steps(
    m: Float64, s: Float64, lower: Float64, upper: Float64, alpha: float
) -> tuple[Float64, Float64]:
    """Mean and standard deviations, (d,) each, that leave their cells with probability alpha.

    m, s: (d,), before.  lower, upper: (d,), the cells of m; both endless where an axis has none.
    """
    mean, std = m.copy(), s.copy()
    edge = np.isfinite(lower) ^ np.isfinite(upper)
    mean[edge] = _within_reach(m, s, np.where(np.isfinite(lower), lower, upper), alpha)[edge]
    inner = np.isfinite(lower) & np.isfinite(upper)
    mean[inner], std[inner] = _with_both_sides(
        m[inner], s[inner], lower[inner], upper[inner], alpha
    )
    return mean, std


def _within_reach(m: Float64, s: Float64, edge: Float64, alpha: float) -> Float64:
    """Means not farther from the edge than the other side's probability alpha allows."""
    reach = ndtri(1 - alpha) * s
    within: Float64 = np.clip(m, edge - reach, edge + reach)
    return within


def _with_both_sides(
    m: Float64, s: Float64, lower: Float64, upper: Float64, alpha: float
) -> tuple[Float64, Float64]:
    """Means and standard deviations that leave [lower, upper] to either side by alpha / 2."""
    below, above = ndtr((lower - m) / s), ndtr((m - upper) / s)
    enough = (below >= alpha / 2) & (above >= alpha / 2)
    inside = 1 - below - above
    below, above = np.maximum(below, alpha / 2), np.maximum(above, alpha / 2)
    excess = below + above + inside - 1
    share = excess / (below + inside + above - 3 * alpha / 2)
    below = np.clip(below - share * (below - alpha / 2), _SMALLEST, _LARGEST)
    above = np.clip(above - share * (above - alpha / 2), _SMALLEST, _LARGEST)
    left, right = ndtri(1 - below), ndtri(1 - above)  # m - lower = left s, upper - m = right s
    mean = (lower * right + upper * left) / (left + right)
    std = (upper - lower) / (left + right)
    return np.where(enough, m, mean), np.where(enough, s, std)


def correct_choice(m: Float64, cov: Float64, alpha: float) -> Float64:
    """Means (K,) of a block of which each value has about alpha at least against the best.

    m: (K,), before.  cov: (K, K), covariance of the coordinates as they are rendered.
    """
    b = int(np.argmax(m))
    variance = np.diag(cov) + cov[b, b] - 2 * cov[b]  # of z_j - z_b
    reach = ndtri(1 - alpha) * np.sqrt(np.maximum(variance, 0.0))
    mean: Float64 = np.maximum(m, m[b] - reach)
    centered: Float64 = mean + (_CENTER - mean.mean())
    return centered
