"""The forward model: features regressed on parameters, and damped Gauss-Newton steps with it.

u (n, d) are parameters minus those of the best candidate b, in units of std; e (n, f) features
minus those of b, and e* (f,) those of the target: the residual.  J (d, f): e ~ u J.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from fide_plugins.population import BY_INDEX, TrainingSample, columns
from fide_plugins.proposers.feature_buffer import FeatureBuffer, for_jacobian
from fide_plugins.runtime.schema import (
    Plain,
    Schema,
    Sides,
    Stateful,
    anything,
    array,
    each,
    flag,
    instance,
    whole,
)
from fide_plugins.types import Float64, Indices

_TINY = 1e-300
_SMALLEST_STD = 1e-9  # of the widest parameter's
_SMALLEST_GAP = 1e-4  # of a leverage to 1


class Jacobian(NamedTuple):
    """Of the features at candidate b, with respect to u.

    best: b, index in the buffer.
    Q: (d, n), J = Q e; J itself is never formed.
    values, vectors: (d,) and (d, d), eigenvalues of J J^T, rising, and eigenvectors in columns.
    rounding: error of the eigenvalues.
    curvature: c, |e - u J|^2 ~ c |u|^4.
    """

    best: int
    Q: Float64
    values: Float64
    vectors: Float64
    rounding: float
    curvature: float


def fit_jacobian(
    u: Float64, gram: Float64, best: int, ridge: tuple[float, float], rounding: float = 0.0
) -> Jacobian:
    """Fit J to steps u (n, d) from candidate `best` and the scalar products of features (n, n).

    First from all candidates, those farther away weighing less, then from the residuals of the 2 d
    nearest, each divided by its distance: of a smooth function the error falls with the square of
    the distance, so steps converge as those of the secant method do.

    gram: of features around any origin.  ridge: penalties of the wide and the near regression.
    rounding: error of an entry of `gram`.
    """
    d = u.shape[1]
    G = gram - gram[best] - gram[best][:, None] + gram[best, best]  # (n, n)
    squared = np.einsum("nd,nd->n", u, u)  # (n,)
    weights = 1 / (squared + max(float(np.median(squared)), _TINY))
    Q = _solve(u * weights[:, None], u, ridge[0])
    order = np.argsort(squared, kind="stable")
    near: Indices = order[squared[order] > 0][: 2 * d]
    curvature = 0.0
    if len(near):
        distances = np.sqrt(squared[near])
        a = u[near] / distances[:, None]  # (n', d)
        P = _solve(a, a, ridge[1])  # (d, n')
        leverages = np.einsum("nd,dn->n", a, P)
        P /= distances  # of residuals that are not yet divided
        change = -(P @ u[near]) @ Q
        change[:, near] += P
        Q = Q + change
        wrong = -u[near] @ Q  # (n', n): of e
        wrong[np.arange(len(near)), near] += 1.0
        energy = np.maximum(np.einsum("in,in->i", wrong @ G, wrong), 0.0)
        energy /= np.square(np.maximum(1 - leverages, _SMALLEST_GAP))  # each left out (PRESS)
        curvature = float(energy.sum() / max(float(np.square(squared[near]).sum()), _TINY))
    values, vectors = np.linalg.eigh(Q @ G @ Q.T)
    error = rounding * float(np.square(Q).sum()) / d
    return Jacobian(best, Q, np.maximum(values, 0.0), vectors, error, curvature)


def _solve(weighted: Float64, u: Float64, penalty: float) -> Float64:
    """(u^T W u + p)^-1 u^T W, (d, n), from W u and u (n, d)."""
    normal = u.T @ weighted
    p = penalty * float(np.trace(normal)) / len(normal) + _TINY
    return np.asarray(np.linalg.solve(normal + p * np.eye(len(normal)), weighted.T), np.float64)


_SMALLEST_PENALTY = 1e-100  # whose square can be divided by
_LEAST_KEPT = 0.01
_FAR = 6.0  # standard deviations between a sample and the best candidate
_MOST_BYTES = 2**28  # of features
_MOST = 3  # generations' worth of steps between two of them, where all of the residual is promised


@dataclass(eq=False)
class GaussNewtonSteps(Stateful):
    """Gauss-Newton steps from the best candidate, with a Jacobian fitted to evaluated candidates.

    x_new = x_b + std * (J J^T + lambda)^-1 (J e* + g lambda (z - x_b) / std)

    with the damping of Levenberg and Marquardt, lambda log-uniform in `damping`, and derivatives
    from evaluated candidates, as in DFO-LS (Cartis et al. 2019).  What lambda damps is that of the
    sample z, to the extent g that the step falls short of removing what J could explain of the
    residual: a model that explains nothing gives z back, one that is right the Gauss-Newton step.

    They come between the generations.  In a generation they would do harm: they rank first on the
    way to the next local optimum, too.  Where the model promises that one removes the share p of
    the residual, up to 3 p k come after a generation of k candidates; they end as soon as
    p < `least_promise` (measured, see `lab/reports/moves.md`).

    Parameters
    ----------
    dim : d, the number of parameters.
    capacity : n, evaluated candidates that are remembered, the better half and the latest half;
        None: `for_jacobian`; fewer if their features would take more than 256 MiB.
    channels : the leading channels of the tokens that are modelled; None: all.
    minimum : candidates that must be known before anything is proposed.
    damping : (low, high), range of lambda, in units of the one that balances the model's errors.
    ridge : penalties of the wide and of the near regression, in units of the mean eigenvalue of
        u^T u.
    longest : longest step, in units of sqrt(d) standard deviations.
    kept : how much of a sample is kept, at most, in directions that lambda damps.
    select : whether tokens that do not vary are left out, see `proposers.feature_buffer`.
    least_promise : see above.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "x": array("n", "d"),
        "losses": array("n"),
        "buffer": anything,
        "new": each(instance(TrainingSample)),
        "due": flag,
        "remaining": whole(),
    }
    dim: int
    capacity: int | None = None
    channels: int | None = None
    minimum: int = 4
    damping: tuple[float, float] = (1e-2, 1e1)
    ridge: tuple[float, float] = (1e-2, 1e-2)
    longest: float = 1.0
    kept: float = 1.0
    select: bool = True
    least_promise: float = 0.25

    def __post_init__(self) -> None:
        """Another search begins elsewhere, with a generation."""
        self.most = self.capacity or for_jacobian(self.dim)
        self.x: Float64 = np.empty((0, self.dim))
        """(n, d), candidates that the model knows."""
        self._losses: Float64 = np.empty(0)
        self._buffer = FeatureBuffer(self.channels, self.select)
        self._fit: tuple[Float64, Jacobian] | None = None  # with its std
        self._new: list[TrainingSample] = []  # the model does not know them yet
        self.due = False
        """Whether a generation was completed and nobody has asked since."""
        self.remaining = 0
        """Steps that may still be asked before the next generation."""

    forget = __post_init__

    # -- when, and how many ------------------------------------------------------------------------

    def add(self, sample: TrainingSample) -> None:
        """Note what was evaluated; of twice what the model remembers, the best and the latest."""
        self._new.append(sample)
        most = max(self.minimum, self.most)
        if len(self._new) > 2 * most:
            losses = np.array([one.loss for one in self._new])
            self._new = [self._new[i] for i in best_and_latest(losses, most)]

    def left(self, popsize: int, target: Tensor, std: Float64) -> int:
        """How many steps come before the next generation of popsize candidates.

        The model learns what is new, and what it promises now may end them.

        target: tokens (T, C).  std: (d,), of the search distribution.
        """
        if not (self.due or self.remaining):
            return 0
        if self._new:
            self.update(*columns(sorted(self._new, key=BY_INDEX)), std)
            self._new = []
        promise = 0.0  # share of |e*|^2 that the model's own step would remove, by the model
        if len(self.x) >= self.minimum:
            _, jacobian, slope = self._model(target, std)
            steps, _ = self._damped(jacobian, slope, np.ones((1, 1)))
            residual = self._buffer.toward(target)[0] - self._buffer.features[jacobian.best]
            removed = _decrease(jacobian, slope, steps)[0]
            promise = float(removed) / (float(residual @ residual) + _TINY)
        if not promise >= self.least_promise:  # or it is NaN
            self.remaining = 0
        elif self.due:
            self.remaining = round(_MOST * promise * popsize)
        self.due = False
        return self.remaining

    def new_ones(self, x: Float64, is_out: Callable[[Float64], bool]) -> Float64:
        """Those of steps x (m, d), as they are rendered, before the first that is not new.

        is_out: whether a point (d,) was asked and not yet told.
        """
        for i, row in enumerate(x):
            known = (self.x == row).all(axis=1).any() or (x[:i] == row).all(axis=1).any()
            if known or is_out(row):
                self.remaining = i
                return x[:i]
        return x

    # -- the model ---------------------------------------------------------------------------------

    def update(self, x: Float64, tokens: Tensor, losses: Float64, std: Float64) -> None:
        """Remember candidates x (n, d), the tokens (n, T, C) of their images, losses (n,)."""
        self._fit = None
        n = max(self.minimum, min(self.most, _MOST_BYTES // (8 * tokens[0].numel())))
        if len(x) > n:
            kept = best_and_latest(losses, n)
            x, tokens, losses = x[kept], tokens[torch.from_numpy(kept)], losses[kept]
        self._buffer.add(tokens, n + len(x))
        self.x = np.concatenate([self.x, x])
        self._losses = np.concatenate([self._losses, losses])
        if len(self.x) > n:
            kept = best_and_latest(self._losses, n)
            self.x, self._losses = self.x[kept], self._losses[kept]
            self._buffer.keep(kept)

    def propose(
        self, z: Float64, target: Tensor, mean: Float64, std: Float64, rng: np.random.Generator
    ) -> Float64:
        """Steps from the best candidate towards the target's tokens (T, C).

        z: (m, d), samples of the search distribution, whose mean and sqrt(diag Sigma) are mean and
        std, (d,) each.  Returns (m, d); values may leave the unit cube.
        """
        scale, jacobian, slope = self._model(target, std)
        low, high = np.log(self.damping)
        damping = np.exp(rng.uniform(low, high, size=(len(z), 1)))
        steps, penalty = self._damped(jacobian, slope, damping)  # (m, d), (m, 1)
        explained = float((slope**2 / (jacobian.values + jacobian.rounding + _TINY)).sum())
        gain = np.clip(_decrease(jacobian, slope, steps)[:, None] / (explained + _TINY), 0.0, 1.0)
        kept = self.kept * (1 - gain)  # (m, 1)
        kept = np.maximum(kept, min(_LEAST_KEPT, self.kept))  # no two proposals are one point
        undetermined = penalty / (jacobian.values + penalty)  # (m, d), in [0, 1]
        sampled = np.clip((z - self.x[jacobian.best]) / scale, -_FAR, _FAR) @ jacobian.vectors
        steps += kept * undetermined * sampled
        proposals: Float64 = self.x[jacobian.best] + scale * (steps @ jacobian.vectors.T)
        return proposals

    def _damped(
        self, jacobian: Jacobian, slope: Float64, damping: Float64
    ) -> tuple[Float64, Float64]:
        """Steps (m, d), none too long, and lambda (m, 1), of damping (m, 1); see `propose`.

        slope: (d,), J e* in the basis of the eigenvectors.  Damping 1 is the lambda whose step
        delta minimizes |e* - delta J|^2 + c |delta|^4, lambda = 2 c |delta|^2, on a grid.
        """
        unit = max(float(jacobian.values.mean()), jacobian.rounding, _SMALLEST_PENALTY)
        grid = unit * np.logspace(-10, 2, 73)
        squared = np.square(slope / (jacobian.values + grid[:, None])).sum(axis=1)  # |delta|^2
        enough = grid >= 2 * jacobian.curvature * squared
        balanced = float(grid[int(np.argmax(enough)) if enough.any() else -1])
        penalty: Float64 = damping * balanced + jacobian.rounding + _TINY
        steps = slope / (jacobian.values + penalty)
        lengths = np.linalg.norm(steps, axis=1, keepdims=True)
        factors = np.minimum(1.0, self.longest * np.sqrt(self.dim) / (lengths + _TINY))
        return steps * factors, penalty

    def _model(self, target: Tensor, std: Float64) -> tuple[Float64, Jacobian, Float64]:
        """Units of u (d,), J at the best candidate, and J e* (d,).

        J is fitted once for whatever was told; J e* is in the basis of the eigenvectors of J J^T.
        """
        floor = max(_SMALLEST_STD * float(std.max()), 1e-15)
        scale: Float64 = np.maximum(std, floor)  # which can be divided by
        if self._fit is None or not np.array_equal(self._fit[0], scale):
            best = int(np.argmin(self._losses))
            u = (self.x - self.x[best]) / scale
            fit = fit_jacobian(u, self._buffer.gram, best, self.ridge, self._buffer.rounding)
            self._fit = scale, fit
        jacobian = self._fit[1]
        b, (wanted, _) = jacobian.best, self._buffer.toward(target)
        missing = wanted - self._buffer.features[b]  # e*
        products = self._buffer.features @ missing  # (n,): e + e_b with e*
        slope: Float64 = jacobian.vectors.T @ (jacobian.Q @ (products - products[b]))
        return scale, jacobian, slope

    def load_state_dict(self, state: Plain, sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; ValueError if it is none.  sides: T, C, device."""
        self._fit = None
        super().load_state_dict(state, {**(sides or {}), "d": self.dim})


def _decrease(jacobian: Jacobian, slope: Float64, steps: Float64) -> Float64:
    """By how much steps (m, d) lower |e*|^2, less what the model misses, (m,); may be negative."""
    decrease: Float64 = steps @ (2 * slope) - np.square(steps) @ jacobian.values
    decrease -= jacobian.curvature * np.square(np.square(steps).sum(axis=1))
    return decrease


def best_and_latest(losses: Float64, n: int) -> Indices:
    """Indices, rising, of n of the candidates (k,), k > n: the latest half, and the best others."""
    earlier = len(losses) - n // 2
    best = np.argsort(losses[:earlier], kind="stable")[: n - n // 2]
    return np.concatenate([np.sort(best), np.arange(earlier, len(losses))])
