"""The forward model: features regressed on parameters, and damped Gauss-Newton steps with it.

Notation
--------
=======  ======  ================================================================================
symbol   shape   meaning
=======  ======  ================================================================================
u        (n, d)  parameters minus those of the best candidate b, in units of std = sqrt(diag Sigma)
e        (n, f)  features minus those of b
e*       (f,)    features of the target minus those of b: the residual
J        (d, f)  Jacobian of the features, e ~ u J
Q        (d, n)  J = Q e; J itself is never formed
G        (n, n)  e e^T
=======  ======  ================================================================================

The linear proposer regresses parameters on features, and asks for the parameters of the target.
This one regresses features on parameters, and asks which step explains the residual:

    x_new = x_b + std * (J J^T + lambda)^-1 J e*,    lambda log-uniform in `damping`,

a Gauss-Newton step with the damping of Levenberg (1944) and Marquardt (1963), where derivatives
come from evaluated candidates, as in DFO-LS (Cartis, Fiala, Marteau, Roberts 2019).  A small lambda
trusts the model, a large one steps only along what the image determines well.  `damping` is in
units of the lambda that the model's own errors ask for.  These grow as c |u|^4 in the square, since
images are curved, and the step delta that minimizes

    |e* - delta J|^2 + c |delta|^4    has    lambda = 2 c |delta|^2:

far from the answer steps are short, and near it they are those of Gauss and Newton.  c comes from
the nearest candidates, each predicted as if it had been left out (Allen 1974, PRESS), so a model
that was fitted to few candidates, or to noise, is trusted little.  Steps are cut to a length.

Short steps from the best candidate would rank before samples for being near it, and the search
would narrow before it has searched.  So a proposal is a sample z that is *denoised*: what lambda
damps, in direction and size, is that of z, to the extent g that the step falls short of removing
what J could explain of the residual:

    x_new = x_b + std * (J J^T + lambda)^-1 (J e* + g lambda (z - x_b) / std).

A model that explains nothing (g = 1, lambda large) gives z back; one that is right (g = 0) gives
the step of Gauss and Newton.

**The Jacobian** is fitted in two stages, each a ridge regression with weights:

1. *wide*: J_0 from all candidates that are remembered, those farther away weighing less.  It knows
   every direction that was ever tried, and is an average over curved functions.
2. *near*: the residuals e - u J_0 of the 2 d nearest candidates, each divided by its distance, are
   regressed in the same way; the result corrects J_0.  Of a smooth function the error of e - u J
   falls with the square of the distance, so the nearest say most of the Jacobian at b itself, and
   steps converge as those of the secant method do.

Both are linear in e, so J = Q e with a matrix Q of d by n, and all that steps need,

    J J^T = Q G Q^T    and    J e* = Q (e e*^T),

comes from scalar products of features: an image costs n of them once, whatever f is.

**Between the generations.** Near the answer of a smooth scene one step of the forward model does
more than a generation.  In a generation such steps would do harm: they rank first on the way to the
next local optimum, too, and the search distribution would follow them there.  So they are evaluated
between two generations, and the search learns no more from them than from points that a user tells
(`FIDE.tell`).

How many there are depends on what the model promises.  Where a step would remove the share p of the
residual, by the model, up to 3 p k steps come after a generation of k candidates.  They end as soon
as p < `least_promise`: on scenes with several basins, and in local optima, a linear model explains
little of the residual.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from fide_plugins.population.candidate import TrainingSample, columns, in_order
from fide_plugins.proposers.base import Previewed, ProposerDefaults
from fide_plugins.proposers.feature_buffer import FeatureBuffer, for_jacobian
from fide_plugins.runtime.schema import (
    Schema,
    Sides,
    anything,
    array,
    check,
    each,
    flag,
    form,
    whole,
)
from fide_plugins.types import Float64, Indices

__all__ = [
    "ForwardProposer",
    "GaussNewtonSteps",
    "Jacobian",
    "balanced",
    "best_and_latest",
    "fit_jacobian",
    "positive",
]

_TINY = 1e-300
_SMALLEST_STD = 1e-9  # of the widest parameter's
_SMALLEST_GAP = 1e-4  # of a leverage to 1


class Jacobian(NamedTuple):
    """Of the features at candidate b, with respect to u."""

    best: int
    """b, index in the buffer."""
    Q: Float64
    """(d, n): J = Q e."""
    values: Float64
    """(d,): eigenvalues of J J^T, rising, at least 0."""
    vectors: Float64
    """(d, d): its eigenvectors, in columns."""
    rounding: float
    """Error of the eigenvalues."""
    curvature: float
    """c: |e - u J|^2 ~ c |u|^4."""


def fit_jacobian(
    u: Float64, gram: Float64, best: int, ridge: tuple[float, float], rounding: float = 0.0
) -> Jacobian:
    """Fit J to steps u (n, d) from candidate `best` and the scalar products of features (n, n).

    gram: of features around any origin.  ridge: penalties of the wide and the near regression.
    rounding: error of an entry of `gram`.
    """
    d = u.shape[1]
    G = gram - gram[best] - gram[best][:, None] + gram[best, best]  # (n, n)
    squared = np.einsum("nd,nd->n", u, u)  # (n,)
    Q = _wide(u, squared, ridge[0])
    near = _nearest(squared, 2 * d)
    curvature = 0.0
    if len(near):
        change, leverages = _near(u, squared, near, Q, ridge[1])
        Q = Q + change
        curvature = _curvature(u, squared, near, Q, G, leverages)
    values, vectors = np.linalg.eigh(Q @ G @ Q.T)
    error = rounding * float(np.square(Q).sum()) / d
    return Jacobian(best, Q, np.maximum(values, 0.0), vectors, error, curvature)


def _wide(u: Float64, squared: Float64, penalty: float) -> Float64:
    """Q (d, n) of J_0: all candidates, weighing less the farther away they are."""
    weights = 1 / (squared + max(float(np.median(squared)), _TINY))
    return _solve(u * weights[:, None], u, penalty)


def _near(
    u: Float64, squared: Float64, near: Indices, Q: Float64, penalty: float
) -> tuple[Float64, Float64]:
    """Change of Q (d, n) by the residuals of the nearest, in units of their distance; leverages."""
    distances = np.sqrt(squared[near])
    a = u[near] / distances[:, None]  # (n', d)
    P = _solve(a, a, penalty)  # (d, n')
    leverages = np.einsum("nd,dn->n", a, P)
    P /= distances  # of residuals that are not yet divided
    change = -(P @ u[near]) @ Q
    change[:, near] += P
    return change, leverages


def _curvature(
    u: Float64, squared: Float64, near: Indices, Q: Float64, G: Float64, leverages: Float64
) -> float:
    """Mean curvature c, of |e - u J|^2 ~ c |u|^4, by the nearest, each left out (PRESS)."""
    wrong = -u[near] @ Q  # (n', n): of e
    wrong[np.arange(len(near)), near] += 1.0
    energy = np.maximum(np.einsum("in,in->i", wrong @ G, wrong), 0.0)
    energy /= np.square(np.maximum(1 - leverages, _SMALLEST_GAP))
    return float(energy.sum() / max(float(np.square(squared[near]).sum()), _TINY))


def _solve(weighted: Float64, u: Float64, penalty: float) -> Float64:
    """(u^T W u + p)^-1 u^T W, (d, n), from W u and u (n, d)."""
    normal = u.T @ weighted
    p = penalty * float(np.trace(normal)) / len(normal) + _TINY
    return np.asarray(np.linalg.solve(normal + p * np.eye(len(normal)), weighted.T), np.float64)


def _nearest(squared: Float64, n: int) -> Indices:
    """The n candidates of smallest squared distance (k,) that is not 0."""
    order = np.argsort(squared, kind="stable")
    moved: Indices = order[squared[order] > 0][:n]
    return moved


def positive(std: Float64) -> Float64:
    """Standard deviations (d,) that can be divided by."""
    floor = max(_SMALLEST_STD * float(std.max()), 1e-15)
    scales: Float64 = np.maximum(std, floor)
    return scales


_FORWARD_SCHEMA: Schema = {
    "x": array("n", "d"),
    "losses": array("n"),
    "buffer": anything,
}
_SMALLEST_PENALTY = 1e-100  # whose square can be divided by
_LEAST_KEPT = 0.01
_FAR = 6.0  # standard deviations between a sample and the best candidate
_MOST_BYTES = 2**28  # of features


class ForwardProposer(Previewed, ProposerDefaults):
    """Gauss-Newton steps from the best candidate, with a Jacobian fitted to evaluated candidates.

    Parameters
    ----------
    dim : d, the number of parameters.
    capacity : n, evaluated candidates that are remembered, the better half and the latest half;
        None: `for_jacobian`; fewer if their features would take more than 256 MiB.
    channels : the leading channels of the tokens that are modelled; None: all.
    damping : (low, high), range of lambda, in units of the one that balances the model's errors.
    ridge : penalties of the wide and of the near regression, in units of the mean eigenvalue of
        u^T u.
    longest : longest step, in units of sqrt(d) standard deviations.
    kept : how much of a sample is kept, at most, in directions that lambda damps.
    minimum : candidates that must be known before anything is proposed.
    select : whether tokens that do not vary are left out, see `proposers.feature_buffer`.
    """

    lazy = True

    def __init__(
        self,
        dim: int,
        *,
        capacity: int | None = None,
        channels: int | None = None,
        damping: tuple[float, float] = (1e-2, 1e1),
        ridge: tuple[float, float] = (1e-2, 1e-2),
        longest: float = 1.0,
        kept: float = 1.0,
        minimum: int = 4,
        select: bool = True,
    ) -> None:
        self.dim, self.minimum = dim, minimum
        self.capacity = for_jacobian(dim) if capacity is None else capacity
        self.channels, self.select = channels, select
        self.damping, self.ridge = damping, ridge
        self.longest, self.kept = longest, kept
        self.forget()

    def forget(self) -> None:
        """Begin with an empty buffer: another search goes elsewhere."""
        self._x: Float64 = np.empty((0, self.dim))
        self._losses: Float64 = np.empty(0)
        self._buffer = FeatureBuffer(self.channels, self.select)
        self._fit: tuple[Float64, Jacobian] | None = None  # with its std

    @property
    def ready(self) -> bool:
        """Whether there is enough to propose from."""
        return len(self._x) >= self.minimum

    def update(self, x: Float64, tokens: Tensor, losses: Float64, std: Float64) -> None:
        """Remember candidates x (n, d), the tokens (n, T, C) of their images, losses (n,)."""
        self._fit = None
        n = max(self.minimum, min(self.capacity, _MOST_BYTES // (8 * tokens[0].numel())))
        if len(x) > n:
            kept = best_and_latest(losses, n)
            x, tokens, losses = x[kept], tokens[torch.from_numpy(kept)], losses[kept]
        self._buffer.add(tokens, n + len(x))
        self._x = np.concatenate([self._x, x])
        self._losses = np.concatenate([self._losses, losses])
        if len(self._x) > n:
            kept = best_and_latest(self._losses, n)
            self._x, self._losses = self._x[kept], self._losses[kept]
            self._buffer.keep(kept)

    def propose(
        self, z: Float64, target: Tensor, mean: Float64, std: Float64, rng: np.random.Generator
    ) -> Float64:
        """Steps from the best candidate towards the target's tokens (T, C).

        z: (m, d), samples of the search distribution, whose mean and sqrt(diag Sigma) are mean and
        std, (d,) each.  Returns (m, d); values may leave the unit cube.
        """
        scale = positive(std)
        jacobian = self._jacobian(scale)
        low, high = np.log(self.damping)
        damping = np.exp(rng.uniform(low, high, size=(len(z), 1)))
        slope = self._slope(jacobian, target)  # (d,), in the basis of eigenvectors, as all below
        steps, penalty = self._damped(jacobian, slope, damping)  # (m, d), (m, 1)
        kept = self.kept * (1 - predicted_gain(jacobian, slope, steps))  # (m, 1)
        kept = np.maximum(kept, min(_LEAST_KEPT, self.kept))  # no two proposals are one point
        undetermined = penalty / (jacobian.values + penalty)  # (m, d), in [0, 1]
        sampled = np.clip((z - self._x[jacobian.best]) / scale, -_FAR, _FAR) @ jacobian.vectors
        steps += kept * undetermined * sampled
        proposals: Float64 = self._x[jacobian.best] + scale * (steps @ jacobian.vectors.T)
        return proposals

    def knows(self, x: Float64) -> bool:
        """Whether x (d,) is among the candidates that are remembered."""
        return bool((self._x == x).all(axis=1).any())

    def promised(self, target: Tensor, std: Float64) -> float:
        """Share of the residual's |e*|^2 that its own step would remove, by the model; at most 1.

        target: tokens (T, C).  std: (d,), of the search distribution.  The step has the damping
        that balances the model's errors, and these count.
        """
        jacobian = self._jacobian(positive(std))
        slope = self._slope(jacobian, target)
        steps, _ = self._damped(jacobian, slope, np.ones((1, 1)))
        residual = self._buffer.missing(target, jacobian.best)
        removed = predicted_decrease(jacobian, slope, steps)[0]
        return float(removed) / (float(residual @ residual) + _TINY)

    def _damped(
        self, jacobian: Jacobian, slope: Float64, damping: Float64
    ) -> tuple[Float64, Float64]:
        """Steps (m, d), none too long, and lambda (m, 1), of damping (m, 1); see `propose`."""
        penalty: Float64 = damping * balanced(jacobian, slope) + jacobian.rounding + _TINY
        steps = slope / (jacobian.values + penalty)
        return steps * self._cut(steps), penalty

    def _cut(self, steps: Float64) -> Float64:
        """Factors (m, 1) that hold steps (m, d) to the longest that is allowed."""
        lengths = np.linalg.norm(steps, axis=1, keepdims=True)
        factors: Float64 = np.minimum(1.0, self.longest * np.sqrt(self.dim) / (lengths + _TINY))
        return factors

    def _slope(self, jacobian: Jacobian, target: Tensor) -> Float64:
        """J e*, (d,), in the basis of the eigenvectors of J J^T."""
        b = jacobian.best
        residual = self._buffer.missing(target, b)  # (f,)
        products = self._buffer.features @ residual  # (n,): of e + e_b with e*
        slope: Float64 = jacobian.vectors.T @ (jacobian.Q @ (products - products[b]))
        return slope

    def _jacobian(self, std: Float64) -> Jacobian:
        """At the best candidate; fitted once for whatever was told."""
        if self._fit is None or not np.array_equal(self._fit[0], std):
            best = int(np.argmin(self._losses))
            u = (self._x - self._x[best]) / std
            fit = fit_jacobian(u, self._buffer.gram, best, self.ridge, self._buffer.rounding)
            self._fit = std.copy(), fit
        return self._fit[1]

    def copy(self) -> Self:
        """Another with the same buffer, which can be updated without this one."""
        other = copy.copy(self)  # arrays are replaced, never written to
        other._buffer = copy.copy(self._buffer)
        return other

    def state_dict(self) -> dict[str, Any]:
        """The buffer."""
        return {"x": self._x, "losses": self._losses, "buffer": self._buffer.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any], sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; ValueError if it is none."""
        own = {"d": self.dim}
        check(state, _FORWARD_SCHEMA, own, "proposer")
        self._fit = None
        self._x, self._losses = state["x"], state["losses"]
        self._buffer.load_state_dict(state["buffer"], {**(sides or {}), "n": own["n"]})


def balanced(jacobian: Jacobian, slope: Float64) -> float:
    """Lambda whose step delta minimizes |e* - delta J|^2 + c |delta|^4: lambda = 2 c |delta|^2.

    slope: (d,), J e* in the basis of the eigenvectors.  Within a factor of 1.5, on a grid.
    """
    scale = max(float(jacobian.values.mean()), jacobian.rounding, _SMALLEST_PENALTY)
    grid = scale * np.logspace(-10, 2, 73)
    lengths = np.square(slope / (jacobian.values + grid[:, None])).sum(axis=1)  # |delta|^2
    enough = grid >= 2 * jacobian.curvature * lengths
    return float(grid[int(np.argmax(enough)) if enough.any() else -1])


def predicted_gain(jacobian: Jacobian, slope: Float64, steps: Float64) -> Float64:
    """How much of the error that J could explain the steps (m, d) remove, (m, 1) in [0, 1].

    `slope` and steps are in the basis of the eigenvectors.
    """
    explained = float((slope**2 / (jacobian.values + jacobian.rounding + _TINY)).sum())
    removed = predicted_decrease(jacobian, slope, steps)[:, None]
    gain: Float64 = np.clip(removed / (explained + _TINY), 0.0, 1.0)
    return gain


def predicted_decrease(jacobian: Jacobian, slope: Float64, steps: Float64) -> Float64:
    """By how much steps (m, d) lower |e*|^2, less what the model misses, (m,); may be negative."""
    decrease: Float64 = steps @ (2 * slope) - np.square(steps) @ jacobian.values
    decrease -= jacobian.curvature * np.square(np.square(steps).sum(axis=1))
    return decrease


def best_and_latest(losses: Float64, n: int) -> Indices:
    """Indices, rising, of n of the candidates (k,), k > n: the latest half, and the best others."""
    earlier = len(losses) - n // 2
    best = np.argsort(losses[:earlier], kind="stable")[: n - n // 2]
    return np.concatenate([np.sort(best), np.arange(earlier, len(losses))])


_MOST = 3  # generations' worth of steps between two of them, where all of the residual is promised

_STEPS_SCHEMA: Schema = {
    "forward": anything,
    "new": each(form(TrainingSample)),
    "due": flag,
    "left": whole(),
}


class GaussNewtonSteps:
    """Which steps come before the next generation.

    forward: the model.
    least_promise: share of the residual that a step must promise to remove, in [0, 1].  It and the
        number of steps were measured, see `lab/reports/moves.md`.

    The model is fitted only when somebody asks for steps.
    """

    def __init__(self, forward: ForwardProposer, least_promise: float = 0.25) -> None:
        self.forward, self.least_promise = forward, least_promise
        self.forget()

    def forget(self) -> None:
        """Another search begins; its first generation comes first."""
        self.forward.forget()
        self._new: list[TrainingSample] = []  # the model does not know them yet
        self._due = False  # whether a generation was completed and nobody has asked since
        self._left = 0

    def add(self, sample: TrainingSample) -> None:
        """Note what was evaluated; of twice what the model remembers, the best and the latest."""
        self._new.append(sample)
        most = max(self.forward.minimum, self.forward.capacity)
        if len(self._new) > 2 * most:
            losses = np.array([one.loss for one in self._new])
            self._new = [self._new[i] for i in best_and_latest(losses, most)]

    def after_generation(self) -> None:
        """Note that a generation was completed."""
        self._due = True

    def left(self, popsize: int, target: Tensor, std: Float64) -> int:
        """How many steps come before the next generation of popsize candidates.

        The model learns what is new, and what it promises now may end them.

        target: tokens (T, C).  std: (d,), of the search distribution.
        """
        if not (self._due or self._left):
            return 0
        self._learn(std)
        promise = self.forward.promised(target, std) if self.forward.ready else 0.0
        if not promise >= self.least_promise:  # or it is NaN
            self._left = 0
        elif self._due:
            self._left = round(_MOST * promise * popsize)
        self._due = False
        return self._left

    def propose(
        self, z: Float64, target: Tensor, mean: Float64, std: Float64, rng: np.random.Generator
    ) -> Float64:
        """Steps (m, d); see `ForwardProposer.propose`."""
        return self.forward.propose(z, target, mean, std, rng)

    def new_ones(self, x: Float64, is_out: Callable[[Float64], bool]) -> Float64:
        """Those of steps x (m, d), as they are rendered, before the first that is not new.

        Integers, choices and walls bring steps to points that were evaluated, that are out, or that
        an earlier step has; then the steps end.

        is_out: whether a point (d,) was asked and not yet told.
        """
        for i, row in enumerate(x):
            if self.forward.knows(row) or is_out(row) or (x[:i] == row).all(axis=1).any():
                self._left = i
                return x[:i]
        return x

    def taken(self, n: int) -> None:
        """Note that n of those that are left were asked; none are, once a generation has begun."""
        self._left = max(0, self._left - n)

    def end(self) -> None:
        """Take no more before the generation that begins now."""
        self._due, self._left = False, 0

    def _learn(self, std: Float64) -> None:
        if self._new:
            self.forward.update(*columns(in_order(self._new)), std)
            self._new = []

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        return {
            "forward": self.forward.state_dict(),
            "new": [sample.state_dict() for sample in self._new],
            "due": self._due,
            "left": self._left,
        }

    def load_state_dict(self, state: Mapping[str, Any], sides: Sides, device: Any) -> None:
        """Put back what `state_dict` gave, tokens on the device; ValueError if it is none."""
        check(state, _STEPS_SCHEMA, dict(sides), "steps")
        self.forward.load_state_dict(state["forward"], sides)
        self._new = [TrainingSample.from_state(sample, device) for sample in state["new"]]
        self._due, self._left = state["due"], state["left"]
