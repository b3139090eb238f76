"""Descents from several points at once: Levenberg-Marquardt steps to where images are the target.

A photograph has a narrow basin, and a learned model's hypotheses lie around it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import numpy as np
from torch import Tensor

from fide_plugins.population import TrainingSample
from fide_plugins.runtime.schema import Plain, Schema, Sides, Stateful, array, whole
from fide_plugins.search.mixed import Axes, shorter
from fide_plugins.types import Float32, Float64

_ROUNDS = (
    (0.0125, 0.005, 3, "S"),
    *((0.0125, 0.005, 3, kind) for kind in "JTT"),
    *((0.0125, 0.004, 2, kind) for kind in "JTT"),
    *((0.0, 0.003, 2, kind) for kind in "JTTT"),
    *((0.0, 0.002, 1, kind) for kind in "JTT"),
)
"""Blur in sides of the image, step of differences, descents, and what a round does: it selects
starts (S), measures Jacobians (J) or tries steps (T)."""
_MOST_POINTS = 66  # of a round that measures Jacobians
_MOST_AXES = 40
_AROUND = 36  # points around a guess, of which starts are selected
_APART = 0.02  # of the unit cube, in some parameter: another start
_DAMPING, _LEAST_DAMPING, _LESS, _MORE = 1e-2, 1e-4, 0.1, 10.0
_RIDGE = 1e-4  # of the mean square of all derivatives: what images do not show stays
_SHARE, _WIDEST = 0.25, 8.0  # of what is open: a step of differences; at most, in steps
_LONGEST = 0.15  # of the unit cube, of a step


class Descents(Stateful):
    """Descents under way; they take turns, and after each blur the better ones go on.

    Each measures derivatives of its features by differences, and then tries steps
    -(J^T J + lambda diag(J^T J))^-1 J^T r, two dampings lambda at a time; J is corrected by what
    each step shows (Broyden 1965).  Features and losses are those at the blur of the round.

    axes: of the cube.  place: points of the cube (n, d) as they are rendered.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "round": whole(0, len(_ROUNDS)),
        "x": array("m", "d", low=0.0, high=1.0),
        "losses": array("m", high=np.inf),
        "damping": array("m", low=0.0),
        "widths": array("d", low=1.0),
        "residuals": array("m", "f"),
        "jacobians": array("m", "d", "f"),
    }

    def __init__(self, axes: Axes, place: Callable[[Float64], Float64]) -> None:
        self._axes, self._place = axes, place
        self.widths = np.ones(axes.dim)  # of differences, in units of the round's
        self._begin(np.empty((0, axes.dim)))
        self.round = len(_ROUNDS)

    def _begin(self, x: Float64) -> None:
        self.round, self.x = 0, x
        self.losses, self.damping = np.full(len(x), np.inf), np.full(len(x), _DAMPING)
        self.residuals: Float32 = np.zeros((len(x), 0), np.float32)
        self.jacobians: Float32 = np.zeros((len(x), self._axes.dim, 0), np.float32)

    rounds = len(_ROUNDS)

    @property
    def possible(self) -> bool:
        """Whether there are few enough parameters to measure a Jacobian."""
        return self._axes.dim <= _MOST_AXES

    @property
    def under_way(self) -> bool:
        """Whether a round is missing."""
        return self.round < len(_ROUNDS)

    @property
    def share(self) -> float:
        """Standard deviation of the present blur, in sides of the image."""
        return _ROUNDS[self.round][0] if self.under_way else 0.0

    def begin_around(self, x: Float64, std: Float64, rng: np.random.Generator) -> None:
        """Begin at the best of points around a guess x (d,)."""
        apart = std * rng.standard_normal((_AROUND, len(x)))
        apart[0] = 0.0
        self._begin(self._rendered(x + apart))

    def begin(self, found: Sequence[tuple[float, Float64]], spread: Float64 | None = None) -> None:
        """Begin at the best distinct ones of points that were found, as loss and x (d,).

        spread: (d,), standard deviations of what is open, where differences are as wide; None:
            nothing is.
        """
        if spread is not None:
            self.widths = np.clip(_SHARE * spread / _ROUNDS[0][1], 1.0, _WIDEST)
        most = max(1, min(_ROUNDS[0][2], _MOST_POINTS // (self._axes.dim + 1)))
        starts: list[Float64] = []
        for _, x in sorted(found, key=lambda one: one[0]):
            if all(self._axes.difference(x, y).max() >= _APART for y in starts):
                starts.append(x)
        self._begin(np.array(starts[:most]).reshape(-1, self._axes.dim))
        self.round = 1  # these are selected

    def draw(self) -> Float64:
        """Candidates (n, d) of the present round; changes nothing."""
        if _ROUNDS[self.round][3] == "S":
            return self.x.copy()
        tries = self._neighbors if _ROUNDS[self.round][3] == "J" else self._trials
        return np.concatenate([tries(i) for i in range(len(self.x))])

    def learn(self, samples: Sequence[TrainingSample], target: Tensor) -> None:
        """Learn from a round's candidates; target: tokens (T, C), as blurred as theirs."""
        known = {one.x.tobytes(): one for one in samples}
        aim = _flat(target)
        _, _, most, kind = _ROUNDS[self.round]
        if kind == "S":
            self.begin([(known[x.tobytes()].loss, x) for x in self.x if x.tobytes() in known])
            return
        if kind == "J":
            self.residuals = np.zeros((len(self.x), len(aim)), np.float32)
            self.jacobians = np.zeros((*self.x.shape, len(aim)), np.float32)
        for i in range(len(self.x)):
            if kind == "J":
                self._differentiate(i, known, aim)
            else:
                self._step(i, known, aim)
        self.round += 1
        if not self.under_way or _ROUNDS[self.round][2] < most:
            self._keep(_ROUNDS[self.round][2] if self.under_way else len(self.x))

    def _keep(self, n: int) -> None:
        """Go on with the best n, the best first."""
        order = np.argsort(self.losses, kind="stable")[:n]
        for name in ("x", "losses", "damping", "residuals", "jacobians"):
            setattr(self, name, getattr(self, name)[order])

    # -- one of them -------------------------------------------------------------------------------

    def _neighbors(self, i: int) -> Float64:
        """Its point and one beside it on each axis, (1 + d, d)."""
        step = _ROUNDS[self.round][1] * self.widths
        beside = np.where(self.x[i] + step <= 1, step, -step)
        return self._rendered(np.vstack([self.x[i], self.x[i] + np.diag(beside)]))

    def _trials(self, i: int) -> Float64:
        """Two steps from its point, (2, d): with its damping, and with less."""
        J, r = self.jacobians[i].astype(np.float64), self.residuals[i].astype(np.float64)
        gram = J @ J.T
        diagonal = np.diag(gram)
        ridge = max(_RIDGE * float(diagonal.mean()), 1e-12)
        steps = []
        for factor in (1.0, _LESS):
            damped = gram + np.diag(factor * self.damping[i] * diagonal + ridge)
            step = -np.linalg.solve(damped, J @ r)
            steps.append(step * min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-12)))
        return self._rendered(self.x[i] + np.array(steps))

    def _rendered(self, x: Float64) -> Float64:
        return self._place(self._axes.inside(x))

    def _differentiate(self, i: int, known: Mapping[bytes, TrainingSample], aim: Float32) -> None:
        points = self._neighbors(i)
        middle = known.get(points[0].tobytes())
        if middle is None:  # it failed
            self.losses[i] = np.inf
            return
        self.losses[i], self.residuals[i] = middle.loss, _flat(middle.tokens) - aim
        for axis, x in enumerate(points[1:]):
            beside, apart = known.get(x.tobytes()), self._apart(points[0], x)[axis]
            if beside is not None and apart:
                self.jacobians[i, axis] = (_flat(beside.tokens) - aim - self.residuals[i]) / apart

    def _step(self, i: int, known: Mapping[bytes, TrainingSample], aim: Float32) -> None:
        """Go to the better one of its trials, if it is better than its point."""
        trials = [known.get(x.tobytes()) for x in self._trials(i)]
        losses = [np.inf if one is None else one.loss for one in trials]
        best = int(np.argmin(losses))
        one = trials[best]
        if one is None or not one.loss < self.losses[i]:
            self.damping[i] *= _MORE
            return
        apart, r = self._apart(self.x[i], one.x), _flat(one.tokens) - aim
        wrong = r - self.residuals[i] - apart.astype(np.float32) @ self.jacobians[i]
        square = max(float(apart @ apart), 1e-12)
        self.jacobians[i] += np.outer(apart / square, wrong).astype(np.float32)
        self.x[i], self.losses[i], self.residuals[i] = one.x, one.loss, r
        if best:
            self.damping[i] = max(_LESS * self.damping[i], _LEAST_DAMPING)

    def _apart(self, x: Float64, y: Float64) -> Float64:
        """Signed differences (d,) of y from x, the shorter way around."""
        return shorter(y - x, self._axes.periodic)

    def load_state_dict(self, state: Plain, sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; raises ValueError for what it cannot have given."""
        super().load_state_dict(state)
        for name in ("x", "losses", "damping", "residuals", "jacobians"):
            setattr(self, name, getattr(self, name).copy())

    def _sides(self) -> Sides:
        return {"d": self._axes.dim}


def _flat(tokens: Tensor) -> Float32:
    return np.asarray(tokens.detach().cpu().numpy().ravel(), np.float32)
