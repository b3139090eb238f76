"""One optimizer in many processes: each keeps a replica, and all are told the same *log*.

The log has points with their losses and features, in an order on which all agree.  So a candidate
has a name, (generation, slot), that means the same to everybody.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Any

import numpy as np
from torch import Tensor

from fide_plugins.evaluation import Evaluation
from fide_plugins.fide import FIDE
from fide_plugins.population import Candidate, CandidateRole, Population, columns
from fide_plugins.runtime.threads import timed
from fide_plugins.saving import as_arrays
from fide_plugins.search.moves import Stage
from fide_plugins.types import Float64
from fide_plugins.validation.points import as_points

_ROUNDING = 1e-9  # of a parameter: what is lost on the way through a user's scale and a database


class Role(StrEnum):
    """What an entry of the log counts for.

    MEMBER: a candidate of the present generation: as if one optimizer had asked it.
    ALTERED: asked in the present generation and yet another point: somebody fixed a parameter, or
        another machine rounds otherwise.
    LATE: asked in an earlier generation of the present search, or when all of this one's candidates
        were pending.
    STEP: a Gauss-Newton step, in no generation.
    INJECTED: all others.  Altered and late ones count, `off_distribution`, where they arrive.
    """

    MEMBER = "member"
    ALTERED = "altered"
    LATE = "late"
    STEP = "step"
    INJECTED = "injected"


class Replica:
    """An optimizer that is told a log, and that nobody else asks or tells.

    Slots beyond the generation's size are drawn from the same distribution, by a generator made
    from (seed, generation, slot).  Rounding that differs from machine to machine must not change
    *when a search is over*: whoever asks says in which generation its search `began`, and whether
    it was `guided`.

    snap: what a candidate (d,) becomes before it is rendered, where parameters are whole numbers,
        choices, or of a scale of their own.
    """

    def __init__(self, optimizer: FIDE, snap: Callable[[Float64], Float64] = np.copy) -> None:
        self.optimizer = optimizer
        optimizer.state.stay_sharp()  # features and losses of the log are of sharp images
        self._snap = snap
        self.generation = 0
        """Number of the present generation."""
        self.began = 0
        """Generation in which the present search, or its tests or restart candidates, began."""
        self.guided = True
        """False if only losses, not images, said where the present search begins."""
        self._batches: dict[int, list[Candidate]] = {}  # of the present generation
        self._taken: set[int] = set()  # slots of the present generation that have counted

    @property
    def _population(self) -> Population:
        return self.optimizer.state.population

    @property
    def size(self) -> int:
        """Entries that make the present generation complete."""
        state = self.optimizer.state
        if 0 not in self._batches and state.moves.stage is Stage.SEARCH:
            return state.search.popsize
        self._open()
        return self._population.size

    def candidate(self, slot: int) -> Candidate:
        """Candidate of the present generation in that slot, from 0."""
        self._open()
        batch, row = divmod(self._own(slot), self.size)
        if batch not in self._batches:
            seed = np.random.SeedSequence(self.optimizer.seed, spawn_key=(self.generation, batch))
            more, rng = Population(), np.random.default_rng(seed)
            self.optimizer.draw(more, rng)
            self._batches[batch] = self._hand_out(more, rng)
        return self._batches[batch][row]

    def _own(self, slot: int) -> int:
        """Slot within the generation of the same candidate, if it needs just its own."""
        return slot % self.size if self.optimizer.state.generation_is_fixed else slot

    def newest(self, slot: int, out: int) -> Candidate:
        """Better one than the candidate in that slot, if the generation does not need that.

        out: entries that are still to be told; with these and those told the generation may be
            complete, and then what is asked now is for the next one (`State.preview_search`).
        """
        if slot >= self.size <= len(self._population.told) + out:
            key = (self.generation, slot, 1)  # never that of `candidate`
            seed = np.random.SeedSequence(self.optimizer.seed, spawn_key=key)
            preview = self._preview(np.random.default_rng(seed))
            if preview is not None:
                return preview
        return self.candidate(slot)

    def _preview(self, rng: np.random.Generator) -> Candidate | None:
        """One candidate of search and proposer as they would be updated now; None: neither."""
        state = self.optimizer.state
        search, proposer = state.preview_search(), state.proposer
        if search is None:
            return None
        if proposer is not None and proposer.lazy and state.samples:
            proposer = copy.copy(proposer)
            proposer.update(*columns(state.samples), state.search.std)
        x, z = search.sample(1, rng)  # (1, d)
        index, proposed = state.population.drawn, False
        share = state.gate.fraction * state.gate.strength
        if proposer is not None and proposer.ready and rng.random() < share:
            v, target = search.stretched(z), self.optimizer.target_tokens
            made = proposer.propose(v, target, search.mean, search.std, rng)
            x, proposed = search.place_proposals(made, z), True
            z = search.closest(x)
        return Candidate(index, x[0], z[0], proposed=proposed, off_distribution=True)

    def step(self, slot: int) -> Candidate | None:
        """A Gauss-Newton step for who asks in that slot; None: a generation comes first.

        Its search has no name: what others know of it is its result.
        """
        if 0 in self._batches:
            return None
        key = (self.generation, slot, 2)
        seed = np.random.SeedSequence(self.optimizer.seed, spawn_key=key)
        x = self.optimizer.make_steps(1, np.random.default_rng(seed))
        if not len(x):
            return None
        z = self.optimizer.state.search.closest(x)
        return Candidate(self._population.drawn, x[0], z[0], CandidateRole.STEP)

    def lose_step(self, generation: int) -> None:
        """A step of that generation failed, or was pruned: its generation comes next."""
        steps = self.optimizer.state.steps
        if steps is not None and generation == self.generation:
            steps.due, steps.remaining = False, 0

    def is_candidate(self, slot: int, x: Float64) -> bool:
        """Whether x (d,) is what becomes of the candidate in that slot."""
        return bool(np.abs(self._snap(self.candidate(slot).x) - x).max() <= _ROUNDING)

    def tell(
        self,
        x: Float64,
        loss: float,
        tokens: Tensor | None = None,
        *,
        generation: int | None = None,
        slot: int = 0,
        proposed: bool = False,
        step: bool = False,
        over: bool | None = None,
        guided: bool | None = None,
    ) -> Role:
        """Next entry of the log; says what it counts for.

        x: (d,) in [0, 1], what was rendered.  tokens: (T, C) of its image, if that is known.
        generation, slot: name of the candidate that was asked; None if it was not.
        proposed: whether the one who asked had it from a proposer.
        step: whether it was a step.
        over, guided: whether somebody began a search after this generation, and by images; None:
            nobody has drawn the next one yet.
        Raises as `FIDE.tell`, before anything changes.
        """
        optimizer = self.optimizer
        results = self._evaluate(x, loss, tokens)
        if step and generation == self.generation:
            role = self._expect_step(x)
        else:
            self._open()
            role, x = self._register(x, None if step else generation, slot, proposed)
        stage, completed = self._stage_of_search(), self._population.generations
        try:
            optimizer.enter(as_points(x[None], optimizer.dim), results, (over, guided))
        finally:  # what training raises comes after the generation was completed
            if self._population.generations != completed:
                self.generation += 1
                self._batches, self._taken = {}, set()
                if self._stage_of_search() != stage:
                    self.began = self.generation
                    self.guided = optimizer.state.moves.guided
        return role

    def _evaluate(self, x: Float64, loss: float, tokens: Tensor | None) -> Evaluation:
        """One entry; raises what `FIDE.tell` raises, before anything changes."""
        optimizer = self.optimizer
        as_points(x[None], optimizer.dim)
        features = None if tokens is None else tokens[None]
        with timed(optimizer.times, "encode"):
            encode = optimizer.state.proposer is not None
            return optimizer.evaluator.evaluate(1, None, np.array([loss]), features, encode=encode)

    def _open(self) -> None:
        """Draw the candidates of the generation; what is still out of others is forgotten."""
        if 0 not in self._batches:
            optimizer = self.optimizer
            optimizer.make_steps(1, np.random.default_rng(0))  # as who had one to ask for
            if not self._population.remaining:  # else it is drawn, and making proposals failed
                self._population.forget_pending()
                optimizer.draw_generation()
            self._batches[0] = self._hand_out(self._population, optimizer.state.rng)

    def _hand_out(self, population: Population, rng: np.random.Generator) -> list[Candidate]:
        """All candidates of a generation that remain."""
        self.optimizer.make_proposals(population, rng)
        return [population.hand_out() for _ in range(population.remaining)]

    def _register(
        self, x: Float64, generation: int | None, slot: int, proposed: bool
    ) -> tuple[Role, Float64]:
        """Make the population expect x, unless it is injected."""
        if generation is None or generation < self.began:
            return Role.INJECTED, x
        is_open = generation == self.generation
        beyond = is_open and slot >= self.size
        is_known, slot = is_open and self.is_candidate(slot, x), self._own(slot)
        if is_known and slot not in self._taken:
            return Role.MEMBER, self._expect_member(slot)
        role = self._expect_other(x, slot if is_open else None, proposed)
        late = generation < self.generation or (
            beyond and (role is CandidateRole.SPARE or not is_known)
        )
        return (Role.LATE if late else Role.ALTERED), x

    def _expect_step(self, x: Float64) -> Role:
        """Expect a step x (d,), before a generation or beside it."""
        population = self._population
        if 0 not in self._batches:
            self.optimizer.make_steps(1, np.random.default_rng(0))  # as who asked for it
            self.optimizer.hand_out_steps(x[None])
        else:  # it comes before these candidates, as where they were drawn later
            drawn, population.drawn = population.drawn, self._batches[0][0].index - 1
            self.optimizer.hand_out_steps(x[None])
            population.drawn = drawn
        return Role.STEP

    def _expect_member(self, slot: int) -> Float64:
        """Expect the candidate of a slot; returns it, (d,)."""
        known = self.candidate(slot)
        self._taken.add(slot)
        if slot >= self.size:  # the others were handed out when the generation was drawn
            self._population.adopt(known.x, known.z, proposed=known.proposed)
        return known.x

    def _expect_other(self, x: Float64, slot: int | None, proposed: bool) -> CandidateRole:
        """Expect x (d,), which is no candidate; returns what it counts for."""
        state, role = self.optimizer.state, CandidateRole.MEMBER
        if state.generation_is_fixed:
            if slot is None or slot in self._taken:
                role = CandidateRole.SPARE
            else:  # it counts in the place of that slot's candidate
                self._taken.add(slot)
                self._population.take(self.candidate(slot).x)
        z = state.search.closest(x[None])[0]
        self._population.adopt(x, z, role, proposed=proposed, off_distribution=True)
        return role

    def _stage_of_search(self) -> tuple[Stage, int]:
        return self.optimizer.state.moves.stage, self.optimizer.state.searches

    def state_dict(self) -> dict[str, Any]:
        """Everything but the optimizer's settings; arrays are those in use, not copies."""
        return {
            "optimizer": as_arrays(self.optimizer.state_dict()), "generation": self.generation,
            "began": self.began, "guided": self.guided, "batches": self._batches,
            "taken": self._taken,
        }  # fmt: skip

    @classmethod
    def from_state(
        cls, optimizer: FIDE, state: Mapping[str, Any], snap: Callable[[Float64], Float64] = np.copy
    ) -> Replica:
        """Go on where `state_dict` was taken, with a new optimizer of the same settings."""
        replica = cls(optimizer, snap)
        optimizer.load_state_dict(state["optimizer"])
        for name in ("generation", "began", "guided"):
            setattr(replica, name, state[name])
        replica._batches, replica._taken = dict(state["batches"]), set(state["taken"])
        return replica
