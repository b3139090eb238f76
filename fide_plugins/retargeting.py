"""The next picture, with all that is remembered of those before it.

See `docs/reference/retarget.md`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.evaluation import Evaluator
from fide_plugins.learning.hypotheses import as_model, posterior_of
from fide_plugins.population.training_sample import TrainingSample, columns
from fide_plugins.proposers import Proposer, make_proposer
from fide_plugins.proposers.feature_buffer import MOST, for_jacobian
from fide_plugins.readings import Readings
from fide_plugins.runtime.machine import timed
from fide_plugins.runtime.threads import one_at_a_time, one_thread
from fide_plugins.search.moves.base import Stage, Start
from fide_plugins.search.recall import Recalled, recall
from fide_plugins.types import Float64, Posterior

if TYPE_CHECKING:
    from fide_plugins.learning.model import Model

__all__ = ["Retargeting"]


class Retargeting(Readings):
    """An optimizer whose target can be changed."""

    def begin_with(self, learned: Any, renders: int = 0) -> None:
        """Begin with hypotheses of a learned model, or without; what was told is forgotten.

        learned: argument of `FIDE`; raises and warns as that does, before anything changes.
        renders: of the same run, from which it was learned.  They count as evaluations.
        """
        model = as_model(learned)
        self.state = self._initial_state(self._posterior(model, self.views.targets))
        self.state.begin_after(renders)
        self._model = model  # of the renderer, so of the next picture, too; it is never saved

    def anywhere(self, number: int) -> Float64:
        """Random point (dim,) that may be rendered; the same for the same number, from 0."""
        rng = np.random.default_rng((self.seed, 3, number))
        x: Float64 = self.state.search.clipped(rng.random((1, self.dim)))[0]
        return x if self.validity is None else self.validity.start(x, number + 2)

    @one_at_a_time
    def begin_at(self, x: Float64) -> None:
        """Begin the first search at x (dim,), which may have been told; candidates are forgotten.

        Where something else comes first, such as hypotheses of a learned model, nothing happens.
        """
        state = self.state
        if state.stage is Stage.SEARCH and not state.population.generations:
            state.begin_at(x)

    def _posterior(self, model: Model | None, target: Any) -> Posterior | None:
        """What a model says of a target, as the seed draws it."""
        return posterior_of(model, self.space or self.dim, target, self.seed)

    @one_at_a_time
    @one_thread
    def retarget(
        self,
        picture: object,
        *,
        loss: str | Callable[..., object] | None = None,
        learned: Any = None,
    ) -> None:
        """Find the parameters of the next picture, with what was learned from earlier ones.

        Parameters
        ----------
        picture
            as `target` of the constructor, of the same size; the range of values stays that of the
            first one, also if that was "auto".
        loss
            None keeps a loss that was given by its name.  A callable, which may know the old
            picture only, must be given again.
        learned
            model of the renderer, or its file, as `learned` of the constructor.  None keeps that
            model, which is not saved: after `load` there is none.

        The search begins at the candidate whose image, of all that are remembered, is nearest to
        the picture, as wide as parameters have to move for it (`search.recall`).  This candidate is
        asked first.  Proposers know the remembered images from the first generation on.  `best`,
        `solutions`, `status` and the local optima begin anew; `evaluations` goes on, and what is
        known of the scene stays: exchangeable blocks, the noise of a pixel.  Candidates that are
        still out may be told, with images or with the loss to the new picture: they count as points
        that were never asked.  Told with the loss to the old picture, one may become a false
        `best`.

        With a model its hypotheses of the picture are rendered after the remembered candidates, and
        the best of all is where the search begins.  The run goes on as one that began with a model:
        without steps between the generations.  Where the remembered candidates say more exactly
        than the model where the parameters are, as those of a slow video do, there are none.

        Without tokens (``proposer="none"``, or losses only) the search begins at the best point so
        far, as wide as the first one, and this point is asked first.

        Raises ImageError, LossError, UnknownNameError or OptionError (ValueErrors), OSError or
        CheckpointError for a file that is no model, before anything changes.
        """
        evaluator = self.evaluator.retargeted(picture, loss)
        model = self._model if learned is None else as_model(learned)
        posterior = self._posterior(model, evaluator.views.targets)
        with timed(self.times, "search"):
            recalled = self._recalled(evaluator)
            if self._knows_better(recalled, posterior):
                posterior = None
            self.evaluator, self._model = evaluator, model
            self.state.retarget(evaluator.target_tokens, recalled.start, posterior)
            if posterior is None:
                self._begin(recalled)
            else:
                self._begin_with_hypotheses(recalled.hypotheses)

    def _recalled(self, evaluator: Evaluator) -> Recalled:
        """What the memory says of the target of an evaluator."""
        state, new = self.state, evaluator.target_tokens
        known = state.moves.known
        samples = state.remembered
        if not samples:  # nothing is known but where the last search came to
            last = self.guess if state.best is None else state.best.solution.x
            x = known.x0 if last is None else last.copy()
            first = np.empty((0, self.dim)) if last is None else x[None]
            return Recalled(Start(x, known.sigma0), first, [], np.empty(0))
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
        self.draw_generation(recalled.hypotheses)

    def _knows_better(self, recalled: Recalled, posterior: Posterior | None) -> bool:
        """Whether the memory says more exactly than a model where the answer is."""
        if posterior is None or not recalled.samples:
            return False
        moves = self.state.moves
        return moves.hypotheses.is_wider(posterior, moves.known, recalled.start)

    def _begin_with_hypotheses(self, remembered: Float64) -> None:
        """Ask for remembered candidates (m, d), and then for hypotheses, in one generation.

        Nothing is taught: a search begins after them, and proposers forget what was before it.
        """
        state = self.state
        state.gate.note_known()
        state.steps = None
        if not self.options.has_network:  # which keeps its weights
            state.proposer = make_proposer(
                self.options, self.dim, self.popsize, self.seed, self.encoder, learned=True
            )
        self.draw_generation(remembered)

    @abstractmethod
    def draw_generation(self, first: Float64 | None = None) -> None:
        """Queue the candidates of the next generation; points `first` (m, d) come first."""


def _teach(proposer: Proposer, samples: list[TrainingSample], std: Float64, popsize: int) -> None:
    """Let a proposer learn from samples as if they came in generations, the best last."""
    for i in range(0, len(samples), popsize):
        proposer.update(*columns(samples[i : i + popsize]), std)
