"""Everything of an optimizer that changes while it runs, and what a checkpoint holds of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from fide_plugins.comparison.scale_space import BLURS, NEXT, REACH, ScaleSpace
from fide_plugins.population import (
    Best,
    Candidate,
    CandidateRole,
    Memory,
    Population,
    TrainingSample,
    columns,
)
from fide_plugins.proposers import Proposer
from fide_plugins.proposers.feature_buffer import MOST, for_jacobian
from fide_plugins.proposers.forward import GaussNewtonSteps
from fide_plugins.proposers.image_gate import ImageGate
from fide_plugins.runtime.schema import (
    GENERATOR,
    Sides,
    anything,
    array,
    check,
    each,
    form,
    instance,
    maybe,
    packed,
    real,
    row,
    saved,
    whole,
)
from fide_plugins.search.moves import Stage, Start
from fide_plugins.search.one_search import Search
from fide_plugins.search.policy import MovePolicy
from fide_plugins.types import Estimate, Float32, Float64, Posterior, Solution
from fide_plugins.validation.values import Clipping
from fide_plugins.views.findings import PixelNoise

if TYPE_CHECKING:
    from fide_plugins.comparison.comparison import Comparison
    from fide_plugins.comparison.kept import Kept
    from fide_plugins.search.recall import Recalled


_GAIN = 0.1  # of the loss, below which an improvement does not count
FOLLOWED = 0.03  # of the unit cube: standard deviation around the last answer, of a photograph
_MOST_INJECTED = 1000  # points never asked that are remembered until a generation is complete
_ENOUGH, _FEWEST = 1 / 2, 4  # of the results of a generation, and results, for a preview


@dataclass
class State:
    """What an optimizer has asked, evaluated and learned.

    rng: of the search; nothing else draws from it.
    moves: what the present generation is for, and where the next search begins.
    gate: how far images steer the search.
    proposer, steps: None where nothing is proposed, where there are no steps between generations.
    pixel_noise: noise of pixels, measured where a test renders one candidate twice.
    scales: the blur at which images are compared now.
    kept: the best renders; None where images are compared as they are.
    memory: samples for the next target and for `Solution.std`.
    searches: begun so far.
    evaluations: points told so far, and renders that were learned from before the search.
    not_finite: points told whose loss was NaN or infinite.
    best: None before the first finite loss.
    improved_at, improved_to: evaluation and loss of the last improvement by more than a tenth.
    samples: evaluated, not yet learned from.  learned: of this generation, learned from already.
    injected: best point (d,) told in this generation that was a step or never asked, and its loss.
    search_best: best since the last search was over.  over_at: evaluations at that time.
    retargeted_at: evaluations when the search for the present target began.
    comparisons: how often it was changed how images are compared.
    clipping: images with values outside [0, 1].
    times: seconds in "encode", "train" and "search".
    """

    rng: np.random.Generator = saved(GENERATOR)
    population: Population = saved(anything)
    search: Search = saved(anything)
    moves: MovePolicy = saved(anything)
    gate: ImageGate = saved(anything)
    proposer: Proposer | None = saved(anything)
    pixel_noise: PixelNoise = saved(anything)
    scales: ScaleSpace = saved(anything)
    kept: Kept | None = saved(anything)
    memory: Memory = saved(anything)
    steps: GaussNewtonSteps | None = saved(anything, default=None)
    searches: int = saved(whole(), default=1)
    evaluations: int = saved(whole(), default=0)
    not_finite: int = saved(whole(), default=0)
    best: Best | None = saved(maybe(instance(Best)), default=None)
    improved_at: int = saved(whole(), default=0)
    improved_to: float = saved(real(high=np.inf), default=np.inf)
    samples: list[TrainingSample] = saved(each(instance(TrainingSample)), default_factory=list)
    learned: list[TrainingSample] = saved(each(instance(TrainingSample)), default_factory=list)
    injected: tuple[Float64, float] | None = saved(
        maybe(row(array("d", low=0.0, high=1.0), real())), default=None
    )
    search_best: TrainingSample | None = saved(maybe(instance(TrainingSample)), default=None)
    over_at: int = saved(whole(), default=0)
    retargeted_at: int = saved(whole(), default=0)
    comparisons: int = saved(whole(), default=0)
    clipping: Clipping = saved(instance(Clipping), default_factory=Clipping)
    times: dict[str, float] = saved(
        {"encode": real(), "train": real(), "search": real()},
        default_factory=lambda: {"encode": 0.0, "train": 0.0, "search": 0.0},
    )

    @property
    def generation_is_fixed(self) -> bool:
        """Whether the present generation, a test, needs exactly the candidates drawn for it."""
        stage, move = self.moves.stage, self.moves.move
        if stage is Stage.RESTART:
            return not self.moves.family[move].has_more
        return stage is not Stage.SEARCH

    def preview_search(self) -> Search | None:
        """Return the search as it would be updated now; nothing else changes.

        Who asks when those told and those awaited are a whole generation renders for the next one.
        So a copy of the search is updated (line 10 of Algorithm 1) with what is known by then.
        None where too few results of the generation are known, or it is not of a search.
        """
        population = self.population
        enough = max(_FEWEST, _ENOUGH * population.size)
        if self.moves.stage is not Stage.SEARCH or len(population.told) < enough:
            return None
        return self.search.preview(*population.members())

    # -- results -----------------------------------------------------------------------------------

    def record(
        self,
        x: Float64,
        loss: float,
        image: Float32 | None,
        tokens: torch.Tensor | None,
        told: float,
    ) -> None:
        """Enter one result: x (d,), its loss, its image (H, W, 3) and tokens (T, C), if known.

        told: loss for the search, of the image as blurred as its tokens.
        """
        finite = bool(np.isfinite(loss) and np.isfinite(told))
        loss, told = (loss, told) if finite else (np.inf, np.inf)
        candidate = self.population.record(x, told)
        if candidate is None:
            number = self.population.drawn
            self.population.drawn += 1
            exact = x = self.search.axes.clipped(x[None])[0]  # what is rendered at x
        else:
            number, exact = candidate.index, candidate.x  # x may have lost digits on its way
        if finite:
            if tokens is not None:
                self._keep(TrainingSample(number, exact.copy(), tokens, told, self.evaluations))
            if image is not None and self.scales.useful is None:
                self.scales.note(number, exact, image)
            repeats = self.moves.stage is Stage.EXCHANGE
            if image is not None and repeats and (exact == self.moves.known.current.x).all():
                self.pixel_noise.note(image.copy())
            other = candidate is None or candidate.role is CandidateRole.STEP
            if other and (self.injected is None or told < self.injected[1]):
                self.injected = (x, told)
            if self.best is None or (loss, number) < (self.best.solution.loss, self.best.index):
                shown = None if image is None else image.copy()
                solution = Solution(x.copy(), loss, self.evaluations, shown)
                self._improve(solution, number, None if candidate is None else exact)
        self.not_finite += not finite
        self.evaluations += 1

    def _improve(self, solution: Solution, number: int, asked: Float64 | None) -> None:
        """Note the best point so far, candidate `number`; asked: (d,), if it was a candidate."""
        if self.best is None or solution.loss < self.improved_to - _GAIN * abs(self.improved_to):
            self.improved_at, self.improved_to = self.evaluations, solution.loss
        mean, search_number = solution.x.copy(), 0
        if asked is not None and self.moves.stage is Stage.SEARCH:
            start = self.search.axes.clipped(self.moves.start.mean[None])[0]
            if not np.array_equal(asked, start):  # which was given, or found before, not by it
                mean, search_number = self.search.mean, self.searches
        self.best = Best(solution, number, mean, search_number)

    def _keep(self, sample: TrainingSample) -> None:
        """Remember a sample until the generation is complete; too many of them, the latest."""
        if not self.scales.blur:
            self.memory.add(sample)
        self.samples.append(sample)
        if self.steps is not None:
            self.steps.add(sample)
        if len(self.samples) > _MOST_INJECTED + 2 * self.population.size:
            del self.samples[0]
        if self.moves.stage not in (Stage.SEARCH, Stage.RESTART):
            return  # tests of the scene are no place where a search ends
        best = self.search_best
        if best is None or (sample.loss, sample.index) < (best.loss, best.index):
            self.search_best = sample

    # -- the end of a generation -------------------------------------------------------------------

    def update_search(self, members: list[Candidate], losses: Float64) -> None:
        """Line 10 of Algorithm 1: the distribution learns from members and their losses (k,)."""
        self.gate.note_ranks(losses, np.array([candidate.proposed for candidate in members]))
        self.search.tell(members, losses, self.injected)
        self.injected = None
        if self.best is not None and self.best.search_number == self.searches:
            self.best = replace(self.best, mean=self.search.mean)
        if self.steps is not None:
            self.steps.due = True

    @property
    def needs_floor(self) -> bool:
        """Whether anybody asks which loss no candidate removes: hypotheses of a photograph.

        Not where renders have a coverage: what they do not cover is free.
        """
        uncovered = self.kept is not None and not self.kept.covered
        return uncovered and self.moves.hypotheses is not None

    def tell_hypotheses(self, kept: Kept, comparison: Comparison) -> None:
        """Tell those of a model what renders of a photograph have shown, before a decision."""
        if (hypotheses := self.moves.hypotheses) is not None:
            hypotheses.covered = kept.covered
            hypotheses.floor = comparison.floor if self.needs_floor else 0.0

    def is_over(self, *, guided: bool) -> bool:
        """Whether the present search is over; guided: whether images guide it.

        A coarse one is, too, where it is as narrow as its blur.
        """
        search, scales, hypotheses = self.search, self.scales, self.moves.hypotheses
        guided = guided or scales.asked or scales.blur > 0
        floor = 0.0 if scales.blur or hypotheses is None else hypotheses.floor
        std = search.distribution.std
        if search.termination.is_over(std, guided=guided, floor=floor):
            return True
        return bool(scales.blur and (search.std < REACH * scales.left[0]).all())

    def finish_search(self, *, guided: bool) -> None:
        """Go on elsewhere; what the best of all searches found is kept.

        guided: whether images say where.
        """
        if self.scales.blur:  # the next of a series begins where this one has arrived
            spread, x = self.search.std, self._arrived
            widest = self.scales.go_on() * self.search.setting.sigma0
            self.moves.start = Start(x, np.minimum(widest, NEXT * spread))
            self.begin_at_blur()
            return
        spent = self.evaluations - self.over_at
        self.moves.after_search(self.search_best, spent, guided=guided or self.scales.asked)
        self.search_best, self.over_at = None, self.evaluations
        self._go_on()

    def finish_stage(
        self,
        members: list[Candidate],
        losses: Float64,
        samples: list[TrainingSample],
        target: torch.Tensor,
    ) -> None:
        """Learn from a generation that was of no search; its losses (k,) and samples.

        target: tokens (T, C), as they were compared.
        """
        asked = {candidate.index for candidate in members}
        own = [sample for sample in samples if sample.index in asked]
        descending = self.moves.stage is Stage.DESCENT
        self.moves.learn(own, members[int(np.argmin(losses))].x, target)
        if descending:
            self.injected = None  # its loss is of this blur
            self.scales.begin_at(BLURS[-1] if self.moves.begins_soft else 0.0)
        self._go_on()

    def _go_on(self) -> None:
        """Forget the generation; begin another search, if that comes next."""
        self.pixel_noise.repeat = None
        self.population.forget_pending()
        if self.moves.stage is Stage.SEARCH:
            self._begin_search()
        elif self.moves.stage is Stage.DESCENT and self.moves.descents is not None:
            self.scales.begin_at(self.moves.descents.share)
        elif self.moves.stage is Stage.RESTART and self.moves.begins_coarse:
            self.scales.left = list(self.scales.blurs)

    def _begin_search(self) -> None:
        """Begin where the moves say; what proposers and steps learned was of the last search."""
        self.searches += 1
        if (validity := self.search.setting.validity) is not None:
            valid = validity.start(self.moves.start.mean, self.searches)
            self.moves.start = replace(self.moves.start, mean=valid)
        self.search = self.new_search()
        for part in (self.proposer, self.steps):
            if part is not None:
                part.forget()

    def new_search(self) -> Search:
        """A search where the moves say; patient where it is coarse, and without a goal."""
        self.moves.start = self.scales.patient(self.moves.start)
        goal = np.inf if self.scales.blur else self.moves.goal
        return Search(self.moves.start, goal, self.search.setting)

    def begin_descents(self) -> bool:
        """Begin descents at the best renders, `kept`, if there are to be any; returns whether."""
        kept = self.kept
        if kept is None or not len(kept) or not self.moves.descends:
            return False
        self.moves.begin_descents(list(zip(kept.losses.tolist(), kept.x, strict=True)))
        self._go_on()
        return True

    # -- coarse to fine ----------------------------------------------------------------------------

    def begin_coarse(self, target: Float32) -> bool:
        """Begin the first search again, coarse, if its first candidates say so; target: packed."""
        if self.scales.useful is not None:
            return False
        start = self.moves.start.mean
        x = self.scales.decide(target, self.gate.agreement, start, self.kept)
        self._let_moves_know()
        if x is None:
            return False
        self.moves.start = replace(self.moves.start, mean=x)
        self.begin_at_blur()
        return True

    def _let_moves_know(self) -> None:
        known, scales = self.moves.known, self.scales
        known.blurs = bool(scales.useful)
        known.only_coarse = scales.asked and known.blurs

    def stay_sharp(self) -> None:
        """Compare sharp images from now on; a coarse search goes on as a sharp one."""
        coarse = self.scales.blur > 0
        self.scales.give_up()
        self.moves.descends = False
        self._let_moves_know()
        if coarse:
            self.population.close_generation()
            self.moves.stage, self.moves.start = Stage.SEARCH, Start(self._arrived, self.search.std)
            self.begin_at_blur()

    def begin_at_blur(self) -> None:
        """Begin a search; what was evaluated at another blur is forgotten."""
        self.samples, self.learned = [], []
        self.search_best = self.injected = None
        self.moves.stage = Stage.SEARCH
        self._go_on()

    @property
    def _arrived(self) -> Float64:
        """Best candidate (d,) of the present search, by the loss that it is told."""
        best = self.search_best
        if best is not None:
            return best.x.copy()
        return np.asarray(self.search.axes.reflected(self.search.mean[None])[0])

    # -- other places and pictures -----------------------------------------------------------------

    def begin_after(self, evaluations: int) -> None:
        """Count on from so many evaluations, and what has happened since from there."""
        self.evaluations = evaluations
        self.improved_at = self.retargeted_at = self.over_at = evaluations

    def begin_at(self, x: Float64) -> None:
        """Begin the present search again at x (d,), before its first generation is complete."""
        self.population.close_generation()
        self.population.forget_pending()
        self.moves.start = replace(self.moves.start, mean=x.copy())
        self.search = Search(self.moves.start, self.moves.goal, self.search.setting)

    def retarget(self, target: torch.Tensor, start: Start, posterior: Posterior | None) -> None:
        """Forget what is of the old target only; search for another, tokens (T, C), from `start`.

        posterior: of the target, by a learned model; its hypotheses come before the search.
        """
        self.population.close_generation()
        self.population.forget_pending()
        self.best = self.injected = self.search_best = None
        self.samples, self.learned = [], []
        self.begin_after(self.evaluations)
        self.improved_to = np.inf
        self.pixel_noise.repeat = None
        self.scales.end()
        self.moves.retarget(target, start, posterior)
        self._begin_search()

    def follow(
        self, x: Float64, std: Float64 | float, guesses: Float64, rng: np.random.Generator
    ) -> None:
        """Begin with descents from around the last answer x (d,), and from guesses (n, d)."""
        self.moves.begin_around(x, std, rng, guesses)
        self._go_on()

    def recall(self, new: torch.Tensor, guess: Float64 | None, popsize: int) -> Recalled:
        """What is remembered that says where the search for a new picture (T, C) begins.

        guess: of the user's, (d,).
        """
        from fide_plugins.search.recall import Recalled, recall

        known, samples, d = self.moves.known, self.remembered, len(self.search.mean)
        if not samples:  # nothing is known but where the last search came to
            last = guess if self.best is None else self.best.solution.x
            x = known.x0 if last is None else last.copy()
            first = np.empty((0, d)) if last is None else x[None]
            return Recalled(Start(x, known.sigma0), first, [], np.empty(0))
        learned = min(max(4 * popsize, for_jacobian(d)), MOST)
        recalled = recall(samples, known, new, popsize, learned)
        self.memory.set_losses(recalled.losses[: len(self.memory.samples)].tolist())
        return recalled

    def teach(self, samples: list[TrainingSample], std: Float64, popsize: int) -> None:
        """Let proposer and steps learn from samples as if they came in generations, the best last.

        std: (d,), of the search that begins.
        """
        if self.proposer is not None:
            for i in range(0, len(samples), popsize):
                self.proposer.update(*columns(samples[i : i + popsize]), std)
        if self.steps is not None:
            for i, sample in enumerate(samples):
                self.steps.add(replace(sample, index=i))

    def draw_moves(self, rng: np.random.Generator) -> Float64:
        """Candidates (n, d) of the present stage, which must not be SEARCH; valid ones only."""
        moves, clipped = self.moves, self.search.axes.clipped
        if (validity := self.search.setting.validity) is None:
            return clipped(moves.draw(rng))
        more = not self.generation_is_fixed
        return validity.redrawn(lambda: clipped(moves.draw(rng)), more, moves.start.mean)

    def estimate_of(self, x: Float64) -> Estimate | None:
        """How well the parameters of a solution (d,) are known, from what is remembered now.

        It is computed when it is read; None if no sample says anything.
        """
        from fide_plugins.uncertainty.estimate import LocalEstimate

        known = self.moves.known
        samples = self.memory.samples + self._ends
        if not samples:
            return None
        return LocalEstimate(
            x,
            samples,
            target=known.target,
            channels=known.channels,
            axes=known.axes,
            discrete=known.axes.discrete,
            blocks=known.exchangeability.blocks,
        )

    @property
    def remembered(self) -> list[TrainingSample]:
        """The memory, and the best of each search; nothing where the memory is empty."""
        samples = self.memory.samples
        if not samples:
            return []
        seen = {(sample.index, sample.x.tobytes()) for sample in samples}
        return samples + [one for one in self._ends if (one.index, one.x.tobytes()) not in seen]

    @property
    def _ends(self) -> list[TrainingSample]:
        ends = [optimum.sample for optimum in self.moves.known.optima.all]
        return ends if self.search_best is None or self.scales.blur else [*ends, self.search_best]

    def state_dict(self) -> dict[str, Any]:
        """All of it as nested dicts of arrays, tensors and numbers, those in use, not copies."""
        state = {name: packed(getattr(self, name)) for name in form(State)}
        return state | {"rng": self.rng.bit_generator.state, "times": dict(self.times)}

    def load_state_dict(self, state: Mapping[str, Any], sides: Sides) -> None:
        """Put back what `state_dict` gave; ValueError if `state` is none of these.

        sides: d, T, C, H, W, by these names, and the device of tokens.
        """
        found = check(state, dict(form(State)), dict(sides))
        self.rng.bit_generator.state = found.pop("rng")
        if state["steps"] is None:
            self.steps = None  # it was saved where there are none, as in a replica
        for name in _LOADED:
            value, one = found.pop(name), getattr(self, name)
            if one is not None:
                one.load_state_dict(value, sides)
        if self.proposer is None and len(self.population.reserved):
            raise ValueError("candidates are reserved for proposals, and nothing is proposed")
        self._let_moves_know()
        self.search = self.new_search()
        self.search.load_state_dict(found.pop("search"))
        for name, value in found.items():
            setattr(self, name, value)


_LOADED = (
    "population", "moves", "gate", "proposer", "steps", "memory", "scales", "pixel_noise", "kept"
)  # fmt: skip
"""Parts of a state that load themselves, the search after them."""
