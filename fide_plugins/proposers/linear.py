"""The closed-form proposer: the best linear denoiser, conditioned on a source and on the target.

Notation
--------
=======  ======  ================================================================================
symbol   shape   meaning
=======  ======  ================================================================================
u        (n, d)  parameters of the buffer, in units of std = sqrt(diag Sigma)
e        (n, f)  features of their images, flattened
w        (n,)    weights, falling with the rank of the loss; they sum to 1
z, m             a sample of the search distribution and its mean
u_c e_c          deviations from the weighted means, times sqrt(w)
G        (n, n)  e e^T, all scalar products of features
K        (f, d)  ridge regression of parameters on features
=======  ======  ================================================================================

For (u, e) jointly Gaussian, the best prediction of the parameters of an image e* from a noisy u is
linear, and when the noise is so loud that u says nothing it is E[u | e*] = mean + (e* - mean) K.
The published denoiser starts from a sample of the search distribution; this one starts from an
evaluated candidate, the *source* i, whose parameters and image are both known, and corrects it by
what is wrong with its own image:

    x_new = x_i + a * std * (e* - e_i) K + r * (z - m),   a ~ U(step), r ~ U(0, noise).

That is the linear denoiser trained on all ordered pairs of the buffer (source i, image e_j, answer
x_j), in closed form: the differences u_j - u_i and e_j - e_i have twice the covariances of u and e,
and the same regression.  Only part of the way is asked for, a random part, because the target lies
outside of what the buffer has seen; and a part of the deviation of the sample z is kept (partial
denoising), so that proposals do not fall on one point.

Not every image tells its parameters: glass beads hide one another, noise drowns small changes, and
with more parameters than candidates some directions were never tried.  What the regression knows
of a parameter is measured by its prediction of candidates that it was not fitted to, R^2 of the
leave-one-out residuals (Allen 1974, PRESS).  Where that is nothing, the parameter of the proposal
is that of the sample z: proposals around the best candidates would rank before samples there too,
for being near what is known to be good, and the search would narrow before it has searched.

The weights say how local the fit is: a fit that counts all candidates alike is true on average over
the distribution, one that counts only the best is true near the target, and greedy.
`lab/reports/ablation.md` has the measurements.

Everything is computed from G, in n dimensions: an image costs n scalar products once, a generation
one system of n equations for each channel subset (`ridge`), for any number of features.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from fide_plugins.options import ProposalOptions
from fide_plugins.proposers.base import Previewed, ProposerDefaults
from fide_plugins.proposers.feature_buffer import FeatureBuffer, explained, ridge
from fide_plugins.runtime.schema import Schema, Sides, anything, array, check, each, flag
from fide_plugins.types import Float64, Indices

if TYPE_CHECKING:
    from scipy.sparse import csc_array

__all__ = ["LinearProposer"]

_DEFAULTS = ProposalOptions()
_SCHEMA: Schema = {
    "x": array("n", "d"),
    "losses": array("n"),
    "buffers": each(anything),
    "screening": flag,
}
_TINY = 1e-300
_SMALLEST_ENERGY = 1e-30
_SMALLEST_SCALE = 1e-9  # of ranks: the best alone counts long before
_MOST_BYTES = 2**28  # of features in one buffer


class _Regression(NamedTuple):
    """Of parameters on features."""

    w: Float64
    """(n,)"""
    coefficients: Float64
    """(n, d): parameters, in units of std, for each scalar product with a candidate."""
    explained: Float64
    """(d,): leave-one-out R^2, at most 1, below 0 where the mean predicts better."""
    slopes: csc_array | None = None
    """(f, d): what features say beyond their products, see `proposers.screening`."""


class LinearProposer(Previewed, ProposerDefaults):
    """Ridge regression from features to parameters, weighted by rank.

    Defaults are those of `ProposalOptions`.

    Parameters
    ----------
    dim : d, the number of parameters.
    capacity : n, evaluated candidates that are remembered, the latest; fewer, though never
        fewer than `minimum`, if their features would take more than 256 MiB.
    channel_subsets : sets of features, each the leading channels of the tokens, None all; every
        proposal uses one of them, drawn at random.
    rank_weight_scale : weights fall as exp(-rank / (rank_weight_scale * n)).
    ridge : penalty, in units of the trace of e_c e_c^T over min(n, 64).
    sources : the best so many candidates are corrected, one drawn for each proposal.
    step : (low, high), how much of the way is asked for.
    noise : largest share of a sample's deviation that is kept.
    r2_threshold : R^2 of a parameter from which on it is wholly proposed, in proportion below; 0
        for always.
    minimum : candidates that must be known before anything is proposed; with screening half, but
        not fewer than 2.
    select : whether tokens that do not vary are left out, see `proposers.feature_buffer`.
    screening : whether a parameter may be predicted from the tokens that show it alone, see
        `proposers.screening`.  It is saved with the buffer: a search that is loaded goes on so.
    """

    def __init__(
        self,
        dim: int,
        *,
        capacity: int,
        channel_subsets: tuple[int | None, ...] = (None,),
        rank_weight_scale: float = _DEFAULTS.rank_weight_scale,
        ridge: float = _DEFAULTS.ridge,
        sources: int = _DEFAULTS.sources,
        step: tuple[float, float] = (_DEFAULTS.shortest_step, _DEFAULTS.longest_step),
        noise: float = _DEFAULTS.sample_noise,
        r2_threshold: float = _DEFAULTS.r2_threshold,
        minimum: int = 2,
        select: bool = _DEFAULTS.select_tokens,
        screening: bool = False,
    ) -> None:
        self.dim, self.capacity, self.minimum = dim, capacity, minimum
        self.channel_subsets, self.select = channel_subsets, select
        self.screening = screening
        self.rank_weight_scale, self.ridge = rank_weight_scale, ridge
        self.sources, self.step, self.noise = sources, step, noise
        self.r2_threshold = r2_threshold
        self.forget()

    lazy = True

    def forget(self) -> None:
        """Begin with an empty buffer: the ranks of another search say nothing about this one."""
        self._x: Float64 = np.empty((0, self.dim))
        self._losses: Float64 = np.empty(0)
        self._buffers = [FeatureBuffer(channels, self.select) for channels in self.channel_subsets]
        self._fits: dict[int, tuple[Float64, _Regression]] = {}  # of buffers, with their std

    @property
    def ready(self) -> bool:
        """Whether there is enough to propose from."""
        return len(self._x) >= (max(2, self.minimum // 2) if self.screening else self.minimum)

    def update(self, x: Float64, tokens: Tensor, losses: Float64, std: Float64) -> None:
        """Remember candidates x (n, d), the tokens (n, T, C) of their images, losses (n,).

        Of more than can be remembered, some of every rank.
        """
        self._fits = {}
        affordable = max(self.minimum, _MOST_BYTES // (8 * tokens[0].numel()))
        n = min(self.capacity, affordable)
        if len(x) > n:
            kept = _of_every_rank(losses, n)
            x, tokens, losses = x[kept], tokens[torch.from_numpy(kept)], losses[kept]
        for buffer in self._buffers:
            buffer.add(tokens, n)
        self._x = np.concatenate([self._x, x])[-n:]
        self._losses = np.concatenate([self._losses, losses])[-n:]

    def propose(
        self,
        z: Float64,
        target: Tensor,
        mean: Float64,
        std: Float64,
        rng: np.random.Generator,
    ) -> Float64:
        """Correct some of the best candidates of the buffer towards the target's tokens (T, C).

        z: (m, d), samples of the search distribution, whose mean and sqrt(diag Sigma) are mean and
        std, (d,) each.  Returns (m, d); values may leave the unit cube.
        """
        ranks = _ranks(self._losses)
        best = np.argsort(ranks)[: self.sources]
        sources = best[rng.integers(len(best), size=len(z))]
        used = rng.integers(len(self._buffers), size=len(z))
        correction, trust = np.empty_like(z), np.empty_like(z)
        for v, buffer in enumerate(self._buffers):
            if (mine := used == v).any():
                fit = self._fitted(v, ranks, std)
                correction[mine] = std * _correct(buffer, fit, sources[mine], target)
                trust[mine] = self._trust(fit)
        a = rng.uniform(*self.step, size=(len(z), 1))
        r = rng.uniform(0.0, self.noise, size=(len(z), 1))
        proposals = self._x[sources] + a * correction + r * (z - mean)
        trusted: Float64 = z + trust * (proposals - z)
        return trusted

    def _fitted(self, v: int, ranks: Indices, std: Float64) -> _Regression:
        """Regression of the buffer of that number, fitted once for whatever was told."""
        if v not in self._fits or not np.array_equal(self._fits[v][0], std):
            self._fits[v] = std.copy(), self._regress(self._buffers[v], ranks, std)
        return self._fits[v][1]

    def _regress(self, buffer: FeatureBuffer, ranks: Indices, std: Float64) -> _Regression:
        """Parameters on the features of a buffer; stable when the buffer has collapsed."""
        n = len(ranks)
        w = _rank_weights(ranks, self.rank_weight_scale * n)
        root = np.sqrt(w)
        u = self._x / np.maximum(std, _TINY)
        u = (u - w @ u) * root[:, None]
        row = buffer.gram @ w
        gram = buffer.gram - row - row[:, None] + w @ row  # products of deviations from the mean
        rounding = buffer.rounding + _SMALLEST_ENERGY
        gram = gram * root * root[:, None]
        fit = ridge(gram, u, self.ridge, rounding)
        all_tokens = fit.coefficients, explained(u, fit, w)
        if not self.screening or not buffer.tokens:
            return _Regression(w, *all_tokens)
        from fide_plugins.proposers.screening import affordable, local_regressions

        if not affordable(n, self.dim, buffer.features.shape[1] // buffer.tokens):
            return _Regression(w, *all_tokens)
        e = (buffer.features - w @ buffer.features) * root[:, None]
        local = local_regressions(
            e, buffer.tokens, u, w,
            gram=gram, penalty=self.ridge, rounding=rounding, all_tokens=all_tokens,
        )  # fmt: skip
        return _Regression(w, local.coefficients, local.explained, local.slopes)

    def _trust(self, fit: _Regression) -> Float64:
        """How much of each parameter is proposed, (d,) in [0, 1]."""
        if self.r2_threshold == 0:
            return np.ones(self.dim)
        return np.clip(fit.explained, 0.0, self.r2_threshold) / self.r2_threshold

    def copy(self) -> Self:
        """Another with the same buffer, which can be updated without this one."""
        other = copy.copy(self)  # arrays are replaced, never written to
        other._buffers = [copy.copy(buffer) for buffer in self._buffers]
        other._fits = dict(self._fits)
        return other

    def state_dict(self) -> dict[str, Any]:
        """The buffer."""
        buffers = [buffer.state_dict() for buffer in self._buffers]
        found = {"x": self._x, "losses": self._losses, "screening": self.screening}
        return found | {"buffers": buffers}

    def load_state_dict(self, state: Mapping[str, Any], sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; ValueError if it is none.

        sides: T of the tokens, if that is known.
        """
        self._fits = {}
        own = {"d": self.dim}
        check(state, _SCHEMA, own, "proposer")
        self.screening = state["screening"]
        self._x, self._losses = state["x"], state["losses"]
        for buffer, saved in zip(self._buffers, state["buffers"], strict=True):
            buffer.load_state_dict(saved, {**(sides or {}), "n": own["n"]})


def _correct(buffer: FeatureBuffer, fit: _Regression, sources: Indices, target: Tensor) -> Float64:
    """(e* - e_i) K for the sources i, (m, d)."""
    products = buffer.products(target, sources)
    deviations = products - (products @ fit.w)[:, None]
    corrections: Float64 = (deviations * np.sqrt(fit.w)) @ fit.coefficients
    if fit.slopes is None:
        return corrections
    distinct, which = np.unique(sources, return_inverse=True)
    missing = np.array([buffer.missing(target, int(i)) for i in distinct])
    local: Float64 = missing @ fit.slopes
    return corrections + local[which]


def _ranks(losses: Float64) -> Indices:
    return np.argsort(np.argsort(losses, kind="stable"), kind="stable")


def _of_every_rank(losses: Float64, n: int) -> Indices:
    """Indices, rising, of n candidates of (m,), m > n, evenly by rank; the best is one of them."""
    by_rank = np.argsort(losses, kind="stable")
    return np.sort(by_rank[np.linspace(0, len(losses) - 1, n).round().astype(np.intp)])


def _rank_weights(ranks: Indices, scale: float) -> Float64:
    w = np.exp(-ranks / max(scale, _SMALLEST_SCALE))
    weights: Float64 = w / w.sum()
    return weights
