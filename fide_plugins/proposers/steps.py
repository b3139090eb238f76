"""Gauss-Newton steps from the best candidate, between the generations of the search.

Near the answer of a smooth scene one step of the forward model (`proposers.forward`) does more than
a generation.  In a generation such steps would do harm: they rank first on the way to the next
local optimum, too, and the search distribution would follow them there.  So they are evaluated
between two generations, and the search learns no more from them than from points that a user tells
(`FIDE.tell`).

How many there are depends on what the model promises.  Where a step would remove the share p of the
residual, by the model, up to 3 p k steps come after a generation of k candidates.  They end as soon
as p < `least_promise`: on scenes with several basins, and in local optima, a linear model explains
little of the residual.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from torch import Tensor

from fide_plugins.population.candidate import (
    TrainingSample,
    columns,
    in_order,
)
from fide_plugins.proposers.forward import ForwardProposer, best_and_latest
from fide_plugins.runtime.schema import Schema, Sides, anything, check, each, flag, form, whole
from fide_plugins.types import Float64

__all__ = ["GaussNewtonSteps"]

_MOST = 3  # generations' worth of steps between two of them, where all of the residual is promised

_SCHEMA: Schema = {
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
        check(state, _SCHEMA, dict(sides), "steps")
        self.forward.load_state_dict(state["forward"], sides)
        self._new = [TrainingSample.from_state(sample, device) for sample in state["new"]]
        self._due, self._left = state["due"], state["left"]
