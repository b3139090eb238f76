"""What the next generation is for, and which move comes next: `MovePolicy`, used by `State`.

A search that is over leads to a move; if that must know more of the scene, to a stage that finds it
out; then restart candidates are rendered, and the next search begins at the best of them.  Of a
photograph a search begins with descents from a model's hypotheses or a guess (`descents`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from torch import Tensor, device

from fide_plugins.population.candidate import TrainingSample
from fide_plugins.runtime.schema import (
    GENERATOR,
    Schema,
    Sides,
    Stateful,
    anything,
    array,
    check,
    flag,
    form,
    maybe,
    real,
    text,
    values,
    whole,
)
from fide_plugins.search.descents import Descents
from fide_plugins.search.exchangeability import Exchangeability
from fide_plugins.search.hypotheses import AFTER_DESCENT, Hypotheses, Resample, probabilities
from fide_plugins.search.mixed import Mixed
from fide_plugins.search.moves import (
    ChangeValue,
    Coarsen,
    HalfTurn,
    Known,
    Move,
    RandomRestart,
    Refine,
    RelocateGroup,
    RelocateSegment,
    Split,
    Stage,
    Start,
)
from fide_plugins.search.scene import Axes, Optima, Removal, Sensitivity, Values, changed
from fide_plugins.space.layout import Layout
from fide_plugins.types import Float64, Posterior

_KEEP = 0.85  # of what is known, at each outcome of the same move
_PRIOR_TRIES = 2.0  # that the prior gain is worth
_FLOOR = 0.3  # of all draws are even
_LEAST = 1e-300  # gain or cost that can be
_VAIN = 1e-200  # gain after thousands of vain tries, of which rates can still be compared


class Choice(Stateful):
    """A bandit that chooses among moves, by their gain per evaluation.

    The gain of a move is the fraction by which it lowered the loss.  Old outcomes count less and
    less; each move keeps a least probability, and one that was not tried yet is taken to be good.

    priors: of each move by its name, the gain in a try that is expected at first, above 0.
    cost: evaluations that a try takes, roughly.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "gain": array("moves", low=_LEAST),
        "cost": array("moves", low=_LEAST),
    }

    def __init__(self, priors: Mapping[str, float], cost: float) -> None:
        self.names = tuple(priors)
        self._gain = _PRIOR_TRIES * np.array(list(priors.values()))
        self._cost = np.full(len(priors), _PRIOR_TRIES * cost)

    def note(self, name: str, gain: float, evaluations: int) -> None:
        """Note the outcome of a move."""
        i = self.names.index(name)
        self._gain, self._cost = self._gain.copy(), self._cost.copy()  # those of a state stay
        self._gain[i] = max(_VAIN, _KEEP * self._gain[i] + min(max(gain, 0.0), 1.0))
        self._cost[i] = _KEEP * self._cost[i] + evaluations

    def probabilities(self, possible: Sequence[str]) -> Float64:
        """Probabilities of those moves."""
        which = [self.names.index(name) for name in possible]
        rates = self._gain[which] / self._cost[which]
        even = 1.0 / len(which)
        p: Float64 = _FLOOR * even + (1 - _FLOOR) * rates / rates.sum()
        return np.asarray(p / p.sum(), np.float64)

    def draw(self, possible: Sequence[str], rng: np.random.Generator) -> str:
        """Draw one of those moves."""
        return possible[int(rng.choice(len(possible), p=self.probabilities(possible)))]

    def _sides(self) -> Sides:
        return {"moves": len(self.names)}


_PLAIN: dict[str, Schema] = {
    "move": maybe(text),
    "loss_only_searches": whole(),
    "guided": flag,
    "descends": flag,
    "noise": maybe(real(0.0)),
}
_SCHEMA: dict[str, Schema] = {
    **_PLAIN,
    "stage": text,
    "start": dict(form(Start)),
    "rng": GENERATOR,
    "incumbent": maybe(form(TrainingSample)),
}
_COST = 12.0  # generations that a move takes, roughly
_CANDIDATES = 20  # restart candidates, at least
_TOLERANCE = 3  # failures of an optimum after which the next one is tried, without blocks


class MovePolicy:
    """Moves, and what is known for them.

    x0, sigma0: (d,), mean and standard deviation of the first search.
    popsize: k; there are at least as many restart candidates.
    target: (T, C), tokens of the target.
    channels: leading channels in which images are compared; None: all.
    seed: of the draws of moves.
    groups: declared exchangeable groups, see `exchangeability.check_groups`; None: to be found.
    layout: what is discrete or periodic in the cube; None: nothing.
    posterior: of a learned model; the run begins with its hypotheses.  None: there is no model.
    descends: whether the run begins with descents, from these or else from x0.

    Raises OptionError for groups that are declared wrongly.
    """

    def __init__(
        self,
        x0: Float64,
        sigma0: Float64,
        popsize: int,
        target: Tensor,
        channels: int | None,
        seed: int,
        groups: Sequence[Sequence[int]] | None = None,
        layout: Layout | None = None,
        posterior: Posterior | None = None,
        *,
        descends: bool = False,
    ) -> None:
        dim = len(x0)
        axes = Axes(dim, layout)
        self.known = Known(
            x0=x0,
            sigma0=sigma0,
            target=target,
            channels=channels,
            exchangeability=Exchangeability(dim, channels, groups, axes),
            removal=Removal(),
            sensitivity=Sensitivity(dim, channels, axes),
            axes=axes,
            place=Mixed(layout).clipped,
            values=Values(axes, layout),
        )
        self._candidates = max(_CANDIDATES, popsize)
        self.hypotheses = Hypotheses(posterior, dim, sets=bool(groups), place=self.known.place)
        self._resample = Resample(self.hypotheses)
        family = _family(self.known, self._resample)
        self._choice = Choice({move.name: move.prior_gain for move in family}, _COST * popsize)
        self._moves = {move.name: move for move in (*family, self.hypotheses)}
        self._rng = np.random.default_rng((seed, 1))
        self.stage, self.move = self.hypotheses.first
        """What the present generation is for; the move under way, None in the first search."""
        self.start = Start(x0, self.known.sigma0)
        self.descents = Descents(axes, self.known.place)
        self.descends = descends and self.descents.possible
        """Whether a run begins with descents."""
        self.noise: float | None = None
        """Standard deviation of the loss of the first local optimum; None: it was not measured."""
        self.loss_only_searches = 0
        """Restarts because losses, not images, said so."""
        self.guided = True
        """Whether images said where to go on when the last search was over."""

    def begin_around_guess(self, rng: np.random.Generator) -> None:
        """Begin with descents from points around the guess."""
        self.descents.begin_around(self.known.x0, self.known.sigma0, rng)
        self.stage = Stage.DESCENT

    @property
    def goal(self) -> float:
        """Loss that the search has to beat; +inf for none."""
        incumbent = self.known.incumbent
        if incumbent is None or self.move is None or not self._the_move.has_goal:
            return np.inf
        return incumbent.loss

    @property
    def begins_coarse(self) -> bool:
        """Whether the next search begins coarse, whatever was measured."""
        return self.move == Coarsen.name

    @property
    def ended(self) -> list[int]:
        """Searches that ended in each of the distinct places, the best first (`status.Facts`)."""
        return [optimum.searches for optimum in self.known.optima.all]

    def probabilities(self, losses: Sequence[float], X: Float64) -> Float64 | None:
        """Probabilities (m,) of answers X (m, d) with these losses; None without hypotheses."""
        if not self.hypotheses.available or not len(X):
            return None
        found, known = self.hypotheses, self.known
        alike = known.exchangeability, known.axes
        return probabilities(losses, X, found.x, found.typical, self.noise, *alike)

    def is_wider(self, posterior: Posterior, start: Start) -> bool:
        """Whether hypotheses of a model say less exactly than a start where the answer is."""
        return self.hypotheses.is_wider(posterior, self.known, start)

    # -- after a search ----------------------------------------------------------------------------

    def after_search(
        self, found: TrainingSample | None, evaluations: int, *, guided: bool
    ) -> Stage:
        """Say what comes after a search that is over.

        found: its best candidate, or that of its restart candidates, whose image is known.
        evaluations: since the last search was over.
        guided: whether images say where to go on.
        """
        self.guided = guided
        if self.hypotheses.waiting:
            return self._after_hypothesis(found, evaluations)
        if found is None or not guided:
            self.known.incumbent, self.guided = None, False
            self.loss_only_searches += 1
            self.move = RandomRestart.name
            restart = self._the_move
            assert isinstance(restart, RandomRestart)
            number = self.loss_only_searches
            self.start = restart.start_without_images(self.known, number, self._rng)
            return self._go(Stage.SEARCH)
        self._note_end(found, evaluations)
        return self._decide()

    def _after_hypothesis(self, found: TrainingSample | None, evaluations: int) -> Stage:
        """Refine what is in the right place, draw again what is open, or take the next one."""
        before = self.known.incumbent
        if found is not None:
            self._note_end(found, evaluations)
        if self.guided and self._refines():
            self.move = Refine.name
            self._begin_at(self.known.current.x)
            self.start = replace(self.start, to_the_end=False)  # other hypotheses wait
            return self._go(Stage.SEARCH)
        if self.guided and self._resamples(before):
            self.move = Resample.name
            return self._go(Stage.RESTART)
        return self._begin_at_hypothesis()

    def _note_end(self, found: TrainingSample, evaluations: int) -> None:
        """Note what the move brought, and who is the incumbent."""
        known, incumbent = self.known, self.known.incumbent
        left = incumbent if self.move is not None and self._the_move.from_incumbent else None
        apart = left is None or known.began_apart(self.start.mean, found.x)
        best = known.optima.note(found, known.exchangeability.distance, began_apart=apart)
        if left is not None:
            self._choice.note(self._the_move.name, _gain(left.loss, found.loss), evaluations)
            if found.loss >= left.loss:
                known.optima.fail(left)
        if best:
            self._leave(found)

    def _leave(self, incumbent: TrainingSample) -> None:
        """Take this optimum for the incumbent."""
        if incumbent is not self.known.incumbent:
            self.known.removal.forget()
        self.known.incumbent = incumbent

    def _decide(self) -> Stage:
        """Choose the next move, and the stage that comes first."""
        known = self.known
        if not known.exchangeability.finished:
            if known.incumbent is None:  # the last search began without images, and was no better
                self._leave(known.optima.all[0].sample)
            return self._go(Stage.EXCHANGE)
        blocks = known.exchangeability.blocks
        following = known.optima.next(_TOLERANCE if blocks is None else len(blocks))
        if following is None:
            self.move = RandomRestart.name
            return self._go(Stage.RESTART)
        self._leave(following)
        moves = self._moves.values()
        possible = [one.name for one in moves if one.from_incumbent and one.possible(known)]
        self.move = self._choice.draw(possible or [RandomRestart.name], self._rng)
        return self._go(self._the_move.needs(known) or Stage.RESTART)

    def _refines(self) -> bool:
        """Whether the best so far is in the right place, and not yet at the end of its search."""
        known, below = self.known, self.hypotheses.strict_above
        if known.incumbent is None or below is None or known.incumbent.loss > below:
            return False
        optimum = known.optima.of(known.incumbent)
        return optimum is not None and not optimum.refined

    def _resamples(self, before: TrainingSample | None) -> bool:
        """Whether to draw again what is open: after a hypothesis, and as long as that helps."""
        known = self.known
        if known.incumbent is None or not self._resample.possible(known):
            return False
        return self.move == self.hypotheses.name or known.incumbent is not before

    def _begin_at(self, x: Float64) -> None:
        """Let the next search begin where the move says, given its restart candidate x (d,)."""
        self.start = self._the_move.begin_at(self.known, x)
        self._the_move.note_begun(self.known, x)

    def _begin_at_hypothesis(self) -> Stage:
        self.move = self.hypotheses.name
        self.start = self.hypotheses.next(self.known, self.start)
        return self._go(Stage.SEARCH)

    def _go(self, stage: Stage) -> Stage:
        self.stage = stage
        return stage

    def retarget(self, target: Tensor, start: Start, posterior: Posterior | None) -> None:
        """Begin at `start`, or with hypotheses, for another target, tokens (T, C).

        What was found of the scene stays: exchangeable blocks, sensitivity, gains of moves.
        """
        known = self.known
        known.target, known.incumbent, known.optima = target, None, Optima()
        known.removal.forget()
        known.values.forget()
        self.hypotheses.begin(posterior)
        self.noise = None  # of the loss, which was to another target
        self.loss_only_searches, self.guided = 0, True
        self.start, (self.stage, self.move) = start, self.hypotheses.first

    # -- a generation that is no search's ----------------------------------------------------------

    def draw(self, rng: np.random.Generator) -> Float64:
        """Candidates (n, d) of the present stage, which must not be SEARCH.  Changes nothing."""
        known = self.known
        if self.stage is Stage.EXCHANGE:
            return known.exchangeability.draw(known.current.x)
        if self.stage is Stage.REMOVAL:
            assert known.exchangeability.blocks is not None
            return known.removal.draw(known.current.x, known.exchangeability.blocks, rng)
        if self.stage is Stage.SENSITIVITY:
            return known.sensitivity.draw(known.current.x, rng)
        if self.stage is Stage.DESCENT:
            return self.descents.draw()
        return self._the_move.draw(known, self._candidates, rng)

    @property
    def has_more(self) -> bool:
        """Whether `draw` gives other candidates each time, which are as good as the first ones."""
        return self.stage is Stage.RESTART and self._the_move.has_more

    def learn(
        self, samples: Sequence[TrainingSample], best: Float64, target: Tensor | None = None
    ) -> Stage:
        """Learn from a generation that was no search's; return what comes next.

        samples: those of its candidates whose images are known, with parameters as they were asked.
        best: (d,), the candidate with the lowest loss, as it was asked.
        target: tokens (T, C), as blurred as those of the samples; None: they are sharp.
        """
        known = self.known
        if self.stage is Stage.DESCENT:
            return self._descend(samples, known.target if target is None else target)
        if self.stage is Stage.RESTART and self._the_move is self.hypotheses:
            found = [(sample.loss, sample.x) for sample in samples]
            self.hypotheses.learn(found, best, known.exchangeability.distance)
            if self.descends and found:
                return self.begin_descents(found)
            return self._begin_at_hypothesis()
        if self.stage is Stage.RESTART:
            self._begin_at(self._most_promising(samples, best))
            return self._go(Stage.SEARCH)
        if self.stage is Stage.EXCHANGE:
            known.exchangeability.learn(known.current, samples, known.place)
            repeats = [one.loss for one in samples if np.array_equal(one.x, known.current.x)]
            if len(repeats) > 1 and max(map(abs, repeats)) < 1e150:  # squares would overflow
                self.noise = float(np.std(repeats, ddof=1))
            return self._decide()
        if self.stage is Stage.REMOVAL:
            blocks = known.exchangeability.blocks
            assert blocks is not None
            known.removal.learn(known.current, samples, blocks, known.channels)
        else:
            known.sensitivity.learn(known.current, samples)
        return self._go(Stage.RESTART)

    def begin_descents(self, found: Sequence[tuple[float, Float64]]) -> Stage:
        """Begin descents at the best of points that were found, as loss and x (d,)."""
        self.descents.begin(found)
        return self._go(Stage.DESCENT)

    def _descend(self, samples: Sequence[TrainingSample], target: Tensor) -> Stage:
        """Learn from a round of descents; searches begin where these end, the best first."""
        self.descents.learn(samples, target)
        if self.descents.under_way and len(self.descents.x):
            return self._go(Stage.DESCENT)
        if not len(self.descents.x):  # no image is known
            return self._go(Stage.SEARCH)
        if self.hypotheses.available:
            self.hypotheses.replace(self.descents.x)
            return self._begin_at_hypothesis()
        std = np.minimum(self.known.sigma0, AFTER_DESCENT)
        self.start = replace(self.start, mean=self.descents.x[0].copy(), std=std)
        return self._go(Stage.SEARCH)

    def _most_promising(self, samples: Sequence[TrainingSample], best: Float64) -> Float64:
        """Return the candidate (d,) at which the search begins.

        Without blocks, copies of the incumbent with a low loss are mostly those that change little.
        So what counts is how much of an image is better than the incumbent's: the sum over tokens
        of the lesser of the two errors.  What a move makes worse, the search makes good again.
        """
        known = self.known
        blocks = known.exchangeability.blocks
        if blocks is not None or not samples or not self._the_move.from_incumbent:
            return best
        if self.begins_coarse:  # the incumbent's tokens are of a sharp image
            return best
        before = changed(known.current.tokens, known.target, known.channels) ** 2
        errors = [changed(s.tokens, known.target, known.channels) ** 2 for s in samples]
        scores = [float(np.minimum(before, error).sum()) for error in errors]
        return samples[int(np.argmin(scores))].x

    @property
    def _the_move(self) -> Move:
        assert self.move is not None
        return self._moves[self.move]

    # -- saving ------------------------------------------------------------------------------------

    @property
    def _parts(self) -> dict[str, Any]:
        names = ("optima", "exchangeability", "removal", "sensitivity", "values")
        found = {name: getattr(self.known, name) for name in names}
        parts = {"hypotheses": self.hypotheses, "descents": self.descents}
        return found | parts | {"choice": self._choice}

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        incumbent = self.known.incumbent
        return {
            **{name: getattr(self, name) for name in _PLAIN},
            "stage": self.stage.value,
            "start": values(self.start),
            "rng": self._rng.bit_generator.state,
            "incumbent": None if incumbent is None else incumbent.state_dict(),
            **{name: part.state_dict() for name, part in self._parts.items()},
        }

    def load_state_dict(
        self, state: Mapping[str, Any], sides: Sides | None = None, device: device | None = None
    ) -> None:
        """Put back what `state_dict` gave, tokens on the device; ValueError if it is none."""
        known = self.known
        (tokens, channels), d = known.target.shape, known.dim
        sides = {"d": d, "T": tokens, "C": channels}
        check(state, {**_SCHEMA, **dict.fromkeys(self._parts, anything)}, dict(sides), "moves")
        self._check(state)
        for name in _PLAIN:
            setattr(self, name, state[name])
        self.stage, self.start = Stage(state["stage"]), Start(**state["start"])
        self._rng.bit_generator.state = state["rng"]
        for name, part in self._parts.items():
            part.load_state_dict(state[name], sides, device)
        saved = state["incumbent"]
        known.incumbent = None if saved is None else TrainingSample.from_state(saved, device)
        for optimum in known.optima.all:  # it is one of them, not a copy
            if known.incumbent is not None and np.array_equal(optimum.sample.x, known.incumbent.x):
                known.incumbent = optimum.sample

    def _check(self, state: Mapping[str, Any]) -> None:
        """Raise ValueError unless stage, move and incumbent fit together."""
        stage, move, moves = Stage(state["stage"]), state["move"], self._moves
        if stage is Stage.DESCENT and state["descents"]["round"] >= self.descents.rounds:
            raise ValueError("moves['stage'] is 'descent', and all rounds are over")
        without = Stage.SEARCH, Stage.EXCHANGE, Stage.DESCENT
        if move not in moves and (move is not None or stage not in without):
            raise ValueError(f"moves['move'] is {move!r} in the stage {stage.value!r}")
        free = stage is Stage.DESCENT
        free = free or (stage is Stage.RESTART and not moves[move].from_incumbent)
        if stage is not Stage.SEARCH and not free and state["incumbent"] is None:
            raise ValueError(f"moves['incumbent'] is None in the stage {stage.value!r}")
        if stage is Stage.REMOVAL and state["exchangeability"]["blocks"] is None:
            raise ValueError("moves['exchangeability']['blocks'] is None while blocks are removed")


def _family(known: Known, resample: Resample) -> list[Move]:
    """Moves that a scene may need."""
    family: list[Move] = [
        Split(), HalfTurn(), RelocateGroup(), RelocateSegment(), Coarsen(), Refine(),
        RandomRestart(),
    ]  # fmt: skip
    if known.values.discrete.any():
        family.append(ChangeValue())
    return [*family, resample]


def _gain(before: float, after: float) -> float:
    """By how much of it a loss was lowered, in [0, 1]; losses may be negative, and of any size."""
    scale = max(abs(before), abs(after), 1e-300)
    return min(1.0, max(0.0, before / scale - after / scale))
