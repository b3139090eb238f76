"""The closed-form proposer: the best linear denoiser, conditioned on a source and on the target.

u (n, d) are parameters of the buffer in units of std, e (n, f) features of their images, w (n,)
weights that fall with the rank of the loss, and K (f, d) the ridge regression of u on e.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from fide_plugins.proposers.base import Proposer
from fide_plugins.proposers.feature_buffer import FeatureBuffer, explained, ridge
from fide_plugins.runtime.schema import Plain, Schema, Sides, Stateful, anything, array, each, flag
from fide_plugins.types import Float64, Indices

if TYPE_CHECKING:
    from scipy.sparse import csc_array


_TINY = 1e-300
_SMALLEST_ENERGY = 1e-30
_SMALLEST_SCALE = 1e-9  # of ranks: the best alone counts long before
_MOST_BYTES = 2**28  # of features in one buffer


class _Regression(NamedTuple):
    """Weights (n,); coefficients (n, d): parameters for each scalar product with a candidate.

    explained: (d,), leave-one-out R^2, at most 1, below 0 where the mean predicts better.
    slopes: (f, d), what features say beyond their products, see `proposers.screening`.
    """

    w: Float64
    coefficients: Float64
    explained: Float64
    slopes: csc_array | None = None


@dataclass(eq=False)
class LinearProposer(Stateful, Proposer):
    """Ridge regression from features to parameters, weighted by rank.

    Each proposal starts from an evaluated candidate, the *source* i, and corrects it by what is
    wrong with its own image; a part of the deviation of the sample z is kept:

        x_new = x_i + a * std * (e* - e_i) K + r * (z - m),   a ~ U(step), r ~ U(0, noise).

    That is the best linear denoiser of all ordered pairs of the buffer (source i, image e_j, answer
    x_j).  Where the regression predicts nothing of a parameter, by its leave-one-out residuals
    (Allen 1974, PRESS), the proposal has that of z: around the best candidates proposals would rank
    first all the same, and the search would narrow before it has searched.

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
        `proposers.screening`.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "x": array("n", "d"),
        "losses": array("n"),
        "buffers": each(anything),
        "screening": flag,
    }
    dim: int
    capacity: int
    channel_subsets: tuple[int | None, ...] = (None,)
    rank_weight_scale: float = 0.5
    ridge: float = 0.02
    sources: int = 5
    step: tuple[float, float] = (0.3, 1.2)
    noise: float = 0.5
    r2_threshold: float = 0.05
    minimum: int = 2
    select: bool = True
    screening: bool = False

    lazy = True

    def __post_init__(self) -> None:
        """Begin with an empty buffer: the ranks of another search say nothing about this one."""
        self._x: Float64 = np.empty((0, self.dim))
        self._losses: Float64 = np.empty(0)
        self._buffers = [FeatureBuffer(channels, self.select) for channels in self.channel_subsets]
        self._fits: dict[int, tuple[Float64, _Regression]] = {}  # of buffers, with their std

    forget = __post_init__

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
            by_rank = np.argsort(losses, kind="stable")
            kept = np.sort(by_rank[np.linspace(0, len(losses) - 1, n).round().astype(np.intp)])
            x, tokens, losses = x[kept], tokens[torch.from_numpy(kept)], losses[kept]
        self._buffers = [copy.copy(buffer) for buffer in self._buffers]  # those of a copy stay
        for buffer in self._buffers:
            buffer.add(tokens, n)
        self._x = np.concatenate([self._x, x])[-n:]
        self._losses = np.concatenate([self._losses, losses])[-n:]

    def propose(
        self, z: Float64, target: Tensor, mean: Float64, std: Float64, rng: np.random.Generator
    ) -> Float64:
        """Correct some of the best candidates of the buffer towards the target's tokens (T, C).

        z: (m, d), samples of the search distribution, whose mean and sqrt(diag Sigma) are mean and
        std, (d,) each.  Returns (m, d); values may leave the unit cube.
        """
        order = np.argsort(self._losses, kind="stable")
        ranks, best = np.argsort(order, kind="stable"), order[: self.sources]
        sources = best[rng.integers(len(best), size=len(z))]
        used = rng.integers(len(self._buffers), size=len(z))
        correction, trust = np.empty_like(z), np.ones_like(z)
        for v, buffer in enumerate(self._buffers):
            if not (mine := used == v).any():
                continue
            if v not in self._fits or not np.array_equal(self._fits[v][0], std):
                self._fits[v] = std.copy(), self._regress(buffer, ranks, std)
            fit, full = self._fits[v][1], self.r2_threshold
            wanted, products = buffer.toward(target)
            products = products - buffer.gram[sources[mine]]  # (e* - e_i) . e_j, (m, n)
            deviations = products - (products @ fit.w)[:, None]
            u = (deviations * np.sqrt(fit.w)) @ fit.coefficients  # (e* - e_i) K
            if fit.slopes is not None:
                u += (wanted - buffer.features[sources[mine]]) @ fit.slopes
            correction[mine] = std * u
            if full:
                trust[mine] = np.clip(fit.explained, 0.0, full) / full
        a = rng.uniform(*self.step, size=(len(z), 1))
        r = rng.uniform(0.0, self.noise, size=(len(z), 1))
        proposals = self._x[sources] + a * correction + r * (z - mean)
        trusted: Float64 = z + trust * (proposals - z)
        return trusted

    def _regress(self, buffer: FeatureBuffer, ranks: Indices, std: Float64) -> _Regression:
        """Parameters on the features of a buffer; stable when the buffer has collapsed."""
        n = len(ranks)
        w = np.exp(-ranks / max(self.rank_weight_scale * n, _SMALLEST_SCALE))
        w = w / w.sum()
        root = np.sqrt(w)
        u = self._x / np.maximum(std, _TINY)
        u = (u - w @ u) * root[:, None]
        row = buffer.gram @ w
        gram = buffer.gram - row - row[:, None] + w @ row  # products of deviations from the mean
        rounding = buffer.rounding + _SMALLEST_ENERGY
        gram = gram * root * root[:, None]
        fit = ridge(gram, u, self.ridge, rounding)
        all_tokens = fit.coefficients, explained(u, fit, w)
        tokens = int(buffer.used.sum())
        if not self.screening or not tokens:
            return _Regression(w, *all_tokens)
        from fide_plugins.proposers.screening import affordable, local_regressions

        if not affordable(n, self.dim, buffer.features.shape[1] // tokens):
            return _Regression(w, *all_tokens)
        e = (buffer.features - w @ buffer.features) * root[:, None]
        local = local_regressions(
            e, tokens, u, w,
            gram=gram, penalty=self.ridge, rounding=rounding, all_tokens=all_tokens,
        )  # fmt: skip
        return _Regression(w, local.coefficients, local.explained, local.slopes)

    def load_state_dict(self, state: Plain, sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; ValueError if it is none."""
        self._fits = {}
        super().load_state_dict(state, {**(sides or {}), "d": self.dim})
