"""The next picture, with all that is remembered of those before it.

See `docs/reference/retarget.md`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from fide_plugins.evaluation import Evaluator
from fide_plugins.learning.hypotheses import posterior_of
from fide_plugins.population.training_sample import TrainingSample, columns
from fide_plugins.proposers import Proposer
from fide_plugins.proposers.remembered import MOST, for_jacobian
from fide_plugins.readings import Readings
from fide_plugins.runtime.locks import one_at_a_time
from fide_plugins.runtime.threads import one_thread
from fide_plugins.runtime.timing import timed
from fide_plugins.search.moves.base import Start
from fide_plugins.search.recall import Recalled, recall
from fide_plugins.types import Float64

__all__ = ["Retargeting"]


class Retargeting(Readings):
    """An optimizer whose target can be changed."""

    def begin_with(self, learned: Any, renders: int = 0) -> None:
        """Begin with hypotheses of a learned model, or without; what was told is forgotten.

        learned: argument of `FIDE`; raises and warns as that does, before anything changes.
        renders: of the same run, from which it was learned.  They count as evaluations.
        """
        space = self.space or self.dim
        self.state = self._initial_state(posterior_of(learned, space, self.target, self.seed))
        self.state.begin_after(renders)

    @one_at_a_time
    @one_thread
    def retarget(self, picture: object, *, loss: str | Callable[..., object] | None = None) -> None:
        """Find the parameters of the next picture, with what was learned from earlier ones.

        Parameters
        ----------
        picture
            as `target` of the constructor, of the same size.
        loss
            None keeps a loss that was given by its name.  A callable, which may know the old
            picture only, must be given again.

        The search begins at the candidate whose image, of all that are remembered, is nearest to
        the picture, as wide as parameters have to move for it (`search.recall`).  This candidate is
        asked first.  Proposers know the remembered images from the first generation on.  `best`,
        `solutions`, `status` and the local optima begin anew; `evaluations` goes on, and what is
        known of the scene stays: exchangeable blocks, the noise of a pixel.  Candidates that are
        still out may be told, with images or with the loss to the new picture: they count as points
        that were never asked.  Told with the loss to the old picture, one may become a false
        `best`.  Hypotheses of a learned model, which are of the first picture, are dropped.

        Without tokens (``proposer="none"``, or losses only) the search begins at the best point so
        far, as wide as the first one.

        Raises ImageError, LossError or UnknownNameError (ValueErrors), before anything changes.
        """
        evaluator = self.evaluator.retargeted(picture, loss)
        with timed(self.times, "search"):
            recalled = self._recalled(evaluator)
            self.evaluator = evaluator
            self.state.retarget(evaluator.target_tokens, recalled.start)
            self._begin(recalled)

    def _recalled(self, evaluator: Evaluator) -> Recalled:
        """What the memory says of the target of an evaluator."""
        state, new = self.state, evaluator.target_tokens
        known = state.moves.known
        samples = state.remembered
        if not samples:
            x = known.x0 if state.best is None else state.best.solution.x
            nothing = np.empty((0, self.dim))
            return Recalled(Start(x.copy(), known.sigma0), nothing, [], np.empty(0))
        learned = min(max(4 * self.popsize, for_jacobian(self.dim)), MOST)
        recalled = recall(samples, known, new, self.popsize, learned)
        state.memory.set_losses(recalled.losses[: len(state.memory.samples)].tolist())
        return recalled

    def _begin(self, recalled: Recalled) -> None:
        """Teach what is remembered, and ask for remembered candidates first."""
        state = self.state
        if state.proposer is not None:
            _teach(state.proposer, recalled.samples, recalled.start.std, self.popsize)
        if state.steps is not None:
            for i, sample in enumerate(recalled.samples):  # the best are the latest
                state.steps.add(replace(sample, index=i))
        self.draw_generation()
        x = state.search.clipped(recalled.hypotheses)[: state.population.remaining]
        none = np.zeros(len(x), bool)
        state.population.replace(0, x, state.search.near(x), proposed=none)

    @abstractmethod
    def draw_generation(self) -> None:
        """Queue the candidates of the next generation."""


def _teach(proposer: Proposer, samples: list[TrainingSample], std: Float64, popsize: int) -> None:
    """Let a proposer learn from samples as if they came in generations, the best last."""
    for i in range(0, len(samples), popsize):
        proposer.update(*columns(samples[i : i + popsize]), std)
