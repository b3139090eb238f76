"""How probable each of several answers is, by a learned model and by what was rendered.

A model's hypotheses are draws from its posterior, so the share of them that lie around an answer is
the answer's probability, as far as the model knows.  Renders know more: an answer that the model
takes for possible may be rendered, and not look like the target.  So

    p_m ~ (share of hypotheses that are nearest to m) * exp(-(L_m - L_best) / T),

where L are the losses at the answers, and T is the noise of a loss, or a hundredth of the median
loss of rendered draws above that of the best answer, if this is larger.  (Hypotheses that were
refined through an emulator are optima, and no measure.)  Answers that the second factor excludes
take no hypotheses from the others.

So one answer that was found has probability 1, wherever the other hypotheses are.  `elsewhere` says
how many of them are near no answer: a mode that no search has reached, perhaps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fide_plugins.search.scene.axes import Axes
from fide_plugins.search.scene.exchangeability import Exchangeability
from fide_plugins.types import Float64

__all__ = ["elsewhere", "nearest_shares", "probabilities", "relative_likelihoods"]

_TYPICAL = 0.01  # of the median loss above the best: a difference of it divides a likelihood by e
_EXCLUDED = 0.01  # relative likelihood below which an answer takes no hypotheses
_NEAREST = 0.1  # of all hypotheses, whose spread says how far "near" is on each axis
_NARROWEST = 1e-3  # standard deviation
_DECILE = 0.1257  # of the absolute value of a standard normal variable
_FAR = 4.0  # standard deviations on any axis, of a normal density that hardly a sample exceeds


def probabilities(
    losses: Sequence[float],
    X: Float64,
    hypotheses: Float64,
    typical: float | None,
    noise: float | None,
    exchangeability: Exchangeability,
    axes: Axes,
) -> Float64:
    """Probabilities (m,) of answers X (m, d) with these losses; they sum to 1.

    hypotheses: (n, d), draws from the posterior.
    typical: median loss of draws; None: not known, and the best answer alone is likely.
    noise: standard deviation of a loss; None: not known.
    """
    likelihood = relative_likelihoods(losses, typical, noise)
    kept = np.flatnonzero(likelihood >= _EXCLUDED)
    shares = np.ones(1)
    if len(kept) > 1:
        shares = nearest_shares(X[kept], hypotheses, exchangeability, axes)
    mass = np.zeros(len(X))
    mass[kept] = shares * likelihood[kept]
    total = float(mass.sum())
    return mass / total if total > 0 else likelihood / likelihood.sum()


def relative_likelihoods(
    losses: Sequence[float], typical: float | None, noise: float | None
) -> Float64:
    """Likelihoods (m,) of answers with these losses; the best one has 1."""
    best = min(losses)
    excess = np.asarray(losses, np.float64) - best
    scale = max(noise or 0.0, 0.0 if typical is None else _TYPICAL * (typical - best))
    if scale <= 0:
        return np.asarray(excess == 0, np.float64)
    return np.asarray(np.exp(-excess / scale), np.float64)


def nearest_shares(
    X: Float64, hypotheses: Float64, exchangeability: Exchangeability, axes: Axes
) -> Float64:
    """Shares (m,) of the hypotheses (n, d) that are nearest to each of the answers X (m, d).

    Axes count by how narrow the hypotheses are around the answers, so that what the picture does
    not show decides nothing.
    """
    apart = np.stack([_squares(x, hypotheses, exchangeability, axes) for x in X])  # (m, n, d)
    n = max(2, int(_NEAREST * len(hypotheses)))
    near = [each[np.argsort(each.sum(axis=1))[:n]].mean(axis=0) for each in apart]
    variance = np.maximum(np.mean(near, axis=0), _NARROWEST**2)  # (d,)
    nearest = (apart / variance).sum(axis=2).argmin(axis=0)
    return np.bincount(nearest, minlength=len(X)) / len(hypotheses)


def elsewhere(
    X: Float64, hypotheses: Float64, exchangeability: Exchangeability, axes: Axes
) -> float:
    """Share of the hypotheses (n, d) that are far from each of the answers X (m, d).

    Far is more than four standard deviations on any axis, as the tenth of all hypotheses that is
    nearest to an answer there tells them.  They seem the wider the fewer hypotheses are around an
    answer: four times as wide with a quarter.  So this may be too little, and 0 for a rare answer.
    """
    far = np.ones(len(hypotheses), bool)
    for x in X:
        apart = np.sqrt(_squares(x, hypotheses, exchangeability, axes))  # (n, d)
        std = np.maximum(np.quantile(apart, _NEAREST, axis=0) / _DECILE, _NARROWEST)
        far &= (apart > _FAR * std).any(axis=1)
    return float(far.mean())


def _squares(
    x: Float64, hypotheses: Float64, exchangeability: Exchangeability, axes: Axes
) -> Float64:
    """Squared differences (n, d) of hypotheses from an answer x (d,), blocks matched."""
    if exchangeability.blocks is not None:
        hypotheses = np.stack([exchangeability.aligned(one, x) for one in hypotheses])
    return np.square(axes.difference(hypotheses, x))
