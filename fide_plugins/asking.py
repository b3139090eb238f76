"""How candidates are handed out: those of a generation, some of the next one, and steps between.

Algorithm 1 draws a generation, and all of it is rendered.  Users ask for any number, tell in any
order, and may have more workers than a generation has candidates.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from fide_plugins.population import CandidateRole, Population
from fide_plugins.population.training_sample import columns
from fide_plugins.preview import make_next
from fide_plugins.retargeting import Retargeting
from fide_plugins.runtime.machine import timed
from fide_plugins.runtime.threads import one_at_a_time, one_thread
from fide_plugins.search.moves.policy import Stage
from fide_plugins.search.one_search import Search
from fide_plugins.types import Float64
from fide_plugins.validation.points import as_points, whole_number

__all__ = ["Asking"]


class Asking(Retargeting):
    """An optimizer that is asked for any number of candidates at a time."""

    @abstractmethod
    def draw(self, population: Population, rng: np.random.Generator) -> None:
        """Draw a generation of the present stage, by `rng`, into a population; only these change.

        It is the optimizer's own population, or another one (`distributed.replica`).
        """

    @abstractmethod
    def _propose(
        self, z: Float64, search: Search, rng: np.random.Generator
    ) -> tuple[Float64, Float64]:
        """Proposals x and their z, (m, d) each, from samples of the search distribution."""

    @one_at_a_time
    @one_thread
    def ask(self, n: int | None = None) -> Float64:
        """Candidates to render, float64 (n, dim) in [0, 1].

        None: what is left of the present generation, or, if all of it is pending, as many again,
        for users with more workers than that.  As soon as what is pending will complete the
        generation, candidates are drawn for the next one (`fide_plugins.preview`).
        Generations have `popsize` candidates; after a search has stalled there may be others, see
        `search.moves`.
        Who asks for a number may get Gauss-Newton steps before a generation (`proposers.steps`).
        """
        n = None if n is None else whole_number("n", n, 1)
        with timed(self.times, "search"):
            if n is None:
                return self._ask(None)
            self.state.population.expect(n)
            steps = self._make_steps(n)
            rest = n - len(steps)
            X = np.concatenate([steps, self._ask(rest)]) if rest else steps
            self._hand_out_steps(steps)  # last: asking for the rest may fail
            return X

    @one_at_a_time
    @one_thread
    def ask_ready(self) -> Float64:
        """As `ask`, but for proposals that wait for training: those come with the next call.

        While these are rendered the network trains, see `proposers.background`.  Between two
        generations: one step.
        """
        with timed(self.times, "search"):
            if len(step := self._make_steps(1)):
                self._hand_out_steps(step)
                return step
            if not (population := self.state.population).remaining:
                self.draw_generation()
        return self.ask(population.ready)

    @one_at_a_time
    def withdraw(self, X: object) -> None:
        """Say that candidates X (n, dim) that were asked will not be told: nobody waits for them.

        Others count in their place.  Points that are not pending are ignored.  Raises PointsError.
        """
        for x in as_points(X, self.dim):
            self.state.population.withdraw(x)

    # -- generations -------------------------------------------------------------------------------

    def _ask(self, n: int | None) -> Float64:
        """Candidates (n, dim) of this generation and of those that follow; None: what is left."""
        population = self.state.population
        if not population.remaining:
            self.draw_generation()
        n = n or population.remaining
        population.expect(n)
        if n > population.remaining - population.unmade:
            self._train_early()
        make_next(self.state, n, self._propose)  # which may fail, before anything is handed out
        X = np.empty((n, self.dim))
        for i, row in enumerate(X):
            if not population.remaining:
                self.draw_generation()
                make_next(self.state, n - i, self._propose)
            row[:] = population.hand_out().x
        return X

    def draw_generation(self, first: Float64 | None = None) -> None:
        """Queue a generation; spare candidates where the present one needs just its own.

        first: (m, d), points that are asked first.  None: the user's guess, before all else.
        """
        state, population = self.state, self.state.population
        if first is None and not population.size and self.guess is not None:
            first = self.guess[None]
        if state.needs_its_own and population.has_begun:
            self._draw_spare()
        elif first is None or state.stage is Stage.SEARCH:
            self.draw(population, state.rng)
        else:  # hypotheses of a model, which all are asked, too
            x = np.concatenate([state.search.clipped(first), state.draw_moves(state.rng)])
            population.draw(x, x)
        if state.steps is not None:
            state.steps.end()  # they come before a generation, not in it
        if state.proposer is None or not state.proposer.background:
            population.settle()
        if first is not None and state.stage is Stage.SEARCH:  # in the place of its first samples
            x = state.search.clipped(first)[: population.remaining]
            population.replace(0, x, state.search.near(x), proposed=np.zeros(len(x), bool))

    def _draw_spare(self) -> None:
        """Queue candidates that the present generation, whose own are drawn, does not need.

        As many as it has, or, if nothing is pending, as many as it lacks.
        """
        state, population = self.state, self.state.population
        n = population.size if population.pending else max(1, population.missing)
        x, _ = state.search.sample(n, state.rng)
        population.draw(x, x, spare=True)

    def _train_early(self) -> None:
        """Line 8, before the generation is complete, where each proposal is made when asked for."""
        state, proposer = self.state, self.state.proposer
        if proposer is None or not proposer.singly:
            return
        if state.population.unmade and state.samples:
            samples = state.take_samples()
            state.learned += samples
            with timed(self.times, "train"):
                proposer.update(*columns(samples), state.search.std)

    # -- steps between two generations -------------------------------------------------------------

    def _make_steps(self, n: int) -> Float64:
        """Steps (m, dim) that come before the next generation, at most n."""
        state, search, target = self.state, self.state.search, self.target_tokens
        if not state.has_steps:
            return np.empty((0, self.dim))
        assert state.steps is not None
        with timed(self.times, "train"):
            left = state.steps.left(search.popsize, target, search.std)
            if not left:
                return np.empty((0, self.dim))
            _, z = search.sample(min(n, left), state.rng)
            v = search.stretched(z)
            x = state.steps.propose(v, target, search.mean, search.std, state.rng)
        return state.steps.new_ones(search.place_proposals(x, z), state.population.is_pending)

    def _hand_out_steps(self, x: Float64) -> None:
        """Count steps (m, dim) as asked."""
        state = self.state
        if len(x):
            assert state.steps is not None
            state.steps.taken(len(x))
        for row in zip(x, state.search.near(x), strict=True):
            state.population.adopt(*row, CandidateRole.STEP)
