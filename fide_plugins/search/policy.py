"""What the next generation is for, and which move comes next: `MovePolicy`, used by `State`.

A search that is over leads to a move; if that must know more of the scene, to a stage that finds it
out; then restart candidates are rendered, and the next search begins at the best of them.  Of a
photograph a search begins with descents from a model's hypotheses or a guess (`descents`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from torch import Tensor

from fide_plugins.population import TrainingSample
from fide_plugins.runtime.schema import (
    GENERATOR,
    Plain,
    Schema,
    Sides,
    Stateful,
    anything,
    array,
    check,
    enum,
    flag,
    instance,
    maybe,
    packed,
    real,
    text,
    whole,
)
from fide_plugins.search.mixed import Axes, Values
from fide_plugins.search.moves import (
    AFTER_DESCENT,
    ChangeValue,
    Coarsen,
    HalfTurn,
    Known,
    Move,
    RandomRestart,
    Rearrange,
    Refine,
    RelocateGroup,
    RelocateSegment,
    Split,
    Stage,
    Start,
)
from fide_plugins.search.scene import Exchangeability, Optima, Removal, Sensitivity, changed
from fide_plugins.types import Float64, Posterior

if TYPE_CHECKING:
    from fide_plugins.search.descents import Descents
    from fide_plugins.search.hypotheses import Hypotheses

_KEEP = 0.85  # of what is known, at each outcome of the same move
_PRIOR_TRIES = 2.0  # that the prior gain is worth
_FLOOR = 0.3  # of all draws are even
_LEAST = 1e-300  # gain or cost that can be
_VAIN = 1e-200  # gain after thousands of vain tries, of which rates can still be compared


class MoveChoice(Stateful):
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

    def _sides(self) -> Sides:
        return {"moves": len(self.names)}


_PLAIN: dict[str, Schema] = {
    "stage": enum(Stage),
    "start": instance(Start),
    "move": maybe(text),
    "loss_only_searches": whole(),
    "guided": flag,
    "descends": flag,
    "noise": maybe(real(0.0)),
}
_PARTS = ("optima", "exchangeability", "removal", "sensitivity", "values")  # of what is known
_COST = 12.0  # generations that a move takes, roughly
_CANDIDATES = 20  # restart candidates, at least
_TOLERANCE = 3  # failures of an optimum after which the next one is tried, without blocks
_RESAMPLE = {"resample": 0.5}  # prior gain of the move that comes with a learned model


class MovePolicy:
    """Moves, and what is known for them.

    x0, sigma0: (d,), mean and standard deviation of the first search.
    popsize: k; there are at least as many restart candidates.
    target: (T, C), tokens of the target.
    channels: leading channels in which images are compared; None: all.
    seed: of the draws of moves.
    groups: declared exchangeable groups, see `scene.check_groups`; None: to be found.
    axes: of the cube; None: nothing is discrete or periodic.
    posterior: of a learned model; the run begins with its hypotheses.  None: there is no model.
    descends: whether the run begins with descents, from these or else from around x0.

    stage: what the present generation is for.  move: under way; None in the first search.
    start: of the present or the next search.
    hypotheses, descents: None before they are needed.
    noise: standard deviation of the loss of the first local optimum; None: it was not measured.
    loss_only_searches: restarts because losses, not images, said so.
    guided: whether images said where to go on when the last search was over.

    Raises OptionError for groups that are declared wrongly.
    """

    hypotheses: Hypotheses | None = None
    descents: Descents | None = None
    noise: float | None = None

    def __init__(
        self,
        x0: Float64,
        sigma0: Float64,
        popsize: int,
        target: Tensor,
        channels: int | None,
        seed: int,
        groups: Sequence[Sequence[int]] | None = None,
        axes: Axes | None = None,
        posterior: Posterior | None = None,
        *,
        descends: bool = False,
    ) -> None:
        dim = len(x0)
        axes = axes or Axes(dim)
        self.known = Known(
            x0=x0,
            sigma0=sigma0,
            target=target,
            channels=channels,
            exchangeability=Exchangeability(axes, channels, groups),
            sensitivity=Sensitivity(axes, channels),
            axes=axes,
            place=axes.clipped,
            values=Values(axes),
        )
        self._candidates = max(_CANDIDATES, popsize)
        self._sets = bool(groups)
        family: list[Move] = [Split()]
        if len(axes.continuous):
            family.append(HalfTurn())
        if dim > 1:
            family += [RelocateGroup(), RelocateSegment(), Rearrange()]
        family += [Coarsen(), Refine(), RandomRestart()]
        if axes.discrete is not None:
            family.append(ChangeValue())
        self.family: dict[str | None, Move] = {move.name: move for move in family}
        priors = {move.name: move.prior_gain for move in family}
        self._choice = MoveChoice(priors | _RESAMPLE, _COST * popsize)
        self._rng = np.random.default_rng((seed, 1))
        self.start = Start(x0, self.known.sigma0)
        self.loss_only_searches, self.guided = 0, True
        self._begin(posterior)
        self.descends = descends and self._need_descents().possible

    def _begin(self, posterior: Posterior | None) -> None:
        """Begin with hypotheses of the target; None: with a search."""
        self.stage, self.move = Stage.SEARCH, None
        if posterior is not None or self.hypotheses is not None:
            self._need_hypotheses().begin(posterior)
        if self.hypotheses is not None and self.hypotheses.available:
            self.stage, self.move = Stage.RESTART, self.hypotheses.name

    def _need_hypotheses(self) -> Hypotheses:
        if self.hypotheses is None:
            from fide_plugins.search.hypotheses import Hypotheses, Resample

            known = self.known
            self.hypotheses = Hypotheses(None, known.axes.dim, sets=self._sets, place=known.place)
            for move in (Resample(self.hypotheses), self.hypotheses):
                self.family[move.name] = move
        return self.hypotheses

    def _need_descents(self) -> Descents:
        if self.descents is None:
            from fide_plugins.search.descents import Descents

            self.descents = Descents(self.known.axes, self.known.place)
        return self.descents

    def is_wider(self, posterior: Posterior, start: Start) -> bool:
        """Whether hypotheses of a model say less exactly than a start where the answer is."""
        return self._need_hypotheses().is_wider(posterior, self.known, start)

    def begin_around(
        self, x: Float64, std: Float64 | float, rng: np.random.Generator, others: Float64
    ) -> None:
        """Begin with descents from points around x (d,), and from some of the others (n, d)."""
        self._need_descents().begin_around(x, std, rng, others)
        self.stage = Stage.DESCENT

    @property
    def goal(self) -> float:
        """Loss that the search has to beat; +inf for none."""
        incumbent = self.known.incumbent
        if incumbent is None or self.move is None or not self.family[self.move].has_goal:
            return np.inf
        return incumbent.loss

    @property
    def begins_coarse(self) -> bool:
        """Whether the next search begins coarse, whatever was measured."""
        return self.move == Coarsen.name

    @property
    def begins_soft(self) -> bool:
        """Whether the search that follows descents begins at the least blur."""
        hypotheses = self.hypotheses
        return self.stage is Stage.SEARCH and hypotheses is not None and hypotheses.are_foreign

    # -- after a search ----------------------------------------------------------------------------

    def after_search(self, found: TrainingSample | None, evaluations: int, *, guided: bool) -> None:
        """Decide what comes after a search that is over.

        found: its best candidate, or that of its restart candidates, whose image is known.
        evaluations: since the last search was over.
        guided: whether images say where to go on.
        """
        self.guided, known = guided, self.known
        hypotheses = self.hypotheses
        if hypotheses is not None and (
            hypotheses.waiting or (self.descends and hypotheses.may_complete and guided)
        ):
            self._after_hypothesis(hypotheses, found, evaluations)
        elif found is None or not guided:
            known.incumbent, self.guided = None, False
            self.loss_only_searches += 1
            self.stage, self.move = Stage.SEARCH, RandomRestart.name
            restart = self.family[self.move]
            assert isinstance(restart, RandomRestart)
            self.start = restart.start_without_images(known, self.loss_only_searches, self._rng)
        else:
            self._note_end(found, evaluations)
            self._choose()

    def _after_hypothesis(
        self, hypotheses: Hypotheses, found: TrainingSample | None, evaluations: int
    ) -> None:
        """Refine what is in the right place, draw again what is open, or take the next one."""
        before = self.known.incumbent
        if found is not None:
            self._note_end(found, evaluations)
        now, below = self.known.incumbent, hypotheses.strict_above
        if self.guided and now is not None:
            optimum = self.known.optima.of(now)
            near = below is not None and now.loss <= below
            if near and optimum is not None and not optimum.refined:
                self.stage, self.move = Stage.SEARCH, Refine.name
                start = self.family[self.move].begin_at(self.known, now.x)
                self.start = replace(start, to_the_end=False)  # other hypotheses wait
                return
            helped = self.move == hypotheses.name or now is not before
            if helped and self.family["resample"].possible(self.known):
                self.stage, self.move = Stage.RESTART, "resample"
                return
        if hypotheses.waiting:
            self._begin_at_hypothesis(hypotheses)
        else:
            self._choose()

    def _note_end(self, found: TrainingSample, evaluations: int) -> None:
        """Note what the move brought, and who is the incumbent."""
        known, incumbent = self.known, self.known.incumbent
        leaves = self.move is not None and self.family[self.move].from_incumbent
        left = incumbent if leaves else None
        apart = left is None or known.began_apart(self.start.mean, found.x)
        best = known.optima.note(found, known.exchangeability.distance, began_apart=apart)
        if left is not None:  # losses may be negative, and of any size
            scale = max(abs(left.loss), abs(found.loss), 1e-300)
            gain = min(1.0, max(0.0, left.loss / scale - found.loss / scale))
            self._choice.note(self.family[self.move].name, gain, evaluations)
            if found.loss >= left.loss:
                known.optima.fail(left)
        if best:
            self._leave(found)

    def _leave(self, incumbent: TrainingSample) -> None:
        """Take this optimum for the incumbent; what was known of removals was of another."""
        if incumbent is not self.known.incumbent:
            self.known.removal, self.known.incumbent = Removal(), incumbent

    def _choose(self) -> None:
        """Choose the next move, and the stage that comes first."""
        known = self.known
        if not known.exchangeability.finished:
            if known.incumbent is None:  # the last search began without images, and was no better
                self._leave(known.optima.all[0].sample)
            self.stage = Stage.EXCHANGE
            return
        blocks = known.exchangeability.blocks
        following = known.optima.next(_TOLERANCE if blocks is None else len(blocks))
        self.stage, self.move = Stage.RESTART, RandomRestart.name
        if following is not None:
            self._leave(following)
            moves = [self.family[name] for name in self._choice.names if name in self.family]
            possible = [one.name for one in moves if one.from_incumbent and one.possible(known)]
            possible = possible or [RandomRestart.name]
            p = self._choice.probabilities(possible)
            self.move = possible[int(self._rng.choice(len(possible), p=p))]
            self.stage = self.family[self.move].needs(known) or Stage.RESTART

    def _begin_at_hypothesis(self, hypotheses: Hypotheses) -> None:
        self.stage, self.move = Stage.SEARCH, hypotheses.name
        self.start = hypotheses.next(self.known, self.start)

    def retarget(self, target: Tensor, start: Start, posterior: Posterior | None) -> None:
        """Begin at `start`, or with hypotheses, for another target, tokens (T, C).

        What was found of the scene stays: exchangeable blocks, sensitivity, gains of moves.
        """
        known = self.known
        known.target, known.incumbent, known.optima = target, None, Optima()
        known.removal, known.values = Removal(), Values(known.axes)
        self.noise = None  # of the loss, which was to another target
        self.loss_only_searches, self.guided = 0, True
        self.start = start
        self._begin(posterior)

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
            return self._need_descents().draw()
        return self.family[self.move].draw(known, self._candidates, rng)

    def learn(
        self, samples: Sequence[TrainingSample], best: Float64, target: Tensor | None = None
    ) -> None:
        """Learn from a generation that was no search's, and decide what comes next.

        samples: those of its candidates whose images are known, with parameters as they were asked.
        best: (d,), the candidate with the lowest loss, as it was asked.
        target: tokens (T, C), as blurred as those of the samples; None: they are sharp.
        """
        known, blocks = self.known, self.known.exchangeability.blocks
        if self.stage is Stage.DESCENT:
            self._descend(samples, known.target if target is None else target)
        elif self.stage is Stage.RESTART and self.family[self.move] is self.hypotheses:
            found = self.hypotheses.before + [(sample.loss, sample.x) for sample in samples]
            self.hypotheses.learn(found, best, known.exchangeability.distance)
            if self.descends and found:
                self.begin_descents(found)
            else:
                self._begin_at_hypothesis(self.hypotheses)
        elif self.stage is Stage.RESTART:
            self.start = self.family[self.move].begin_at(known, self._most_promising(samples, best))
            self.stage = Stage.SEARCH
        elif self.stage is Stage.EXCHANGE:
            known.exchangeability.learn(known.current, samples, known.place)
            repeats = [one.loss for one in samples if np.array_equal(one.x, known.current.x)]
            if len(repeats) > 1 and max(map(abs, repeats)) < 1e150:  # squares would overflow
                self.noise = float(np.std(repeats, ddof=1))
            self._choose()
        else:
            if self.stage is Stage.REMOVAL and blocks is not None:
                known.removal.learn(known.current, samples, blocks, known.channels)
            else:
                known.sensitivity.learn(known.current, samples)
            self.stage = Stage.RESTART

    def begin_descents(self, found: Sequence[tuple[float, Float64]]) -> None:
        """Begin descents at the best of points that were found, as loss and x (d,).

        With a model the best is completed first.
        """
        hypotheses, spread = self.hypotheses, None
        if hypotheses is not None and hypotheses.may_complete:
            if hypotheses.complete(found, self.known):
                self.stage, self.move = Stage.RESTART, hypotheses.name
                return
            spread = hypotheses.spread(min(found, key=lambda one: one[0])[1], self.known)
        self._need_descents().begin(found, spread)
        self.stage = Stage.DESCENT

    def _descend(self, samples: Sequence[TrainingSample], target: Tensor) -> None:
        """Learn from a round of descents; searches begin where these end, the best first."""
        descents = self._need_descents()
        descents.learn(samples, target)
        if descents.under_way and len(descents.x):
            return
        self.stage = Stage.SEARCH
        if not len(descents.x):  # no image is known
            return
        if self.hypotheses is not None and self.hypotheses.available:
            self.hypotheses.replace(descents.x)
            self._begin_at_hypothesis(self.hypotheses)
        else:
            std = np.minimum(self.known.sigma0, AFTER_DESCENT)
            self.start = replace(self.start, mean=descents.x[0].copy(), std=std)

    def _most_promising(self, samples: Sequence[TrainingSample], best: Float64) -> Float64:
        """Return the candidate (d,) at which the search begins.

        Without blocks, copies of the incumbent with a low loss are mostly those that change little.
        So what counts is how much of an image is better than the incumbent's: the sum over tokens
        of the lesser of the two errors.  What a move makes worse, the search makes good again.
        """
        known = self.known
        blocks = known.exchangeability.blocks
        if blocks is not None or not samples or not self.family[self.move].from_incumbent:
            return best
        if self.begins_coarse:  # the incumbent's tokens are of a sharp image
            return best
        before = changed(known.current.tokens, known.target, known.channels) ** 2
        errors = [changed(s.tokens, known.target, known.channels) ** 2 for s in samples]
        scores = [float(np.minimum(before, error).sum()) for error in errors]
        return samples[int(np.argmin(scores))].x

    # -- saving ------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        own = {name: packed(getattr(self, name)) for name in (*_PLAIN, "hypotheses", "descents")}
        own |= {name: packed(getattr(self.known, name)) for name in ("incumbent", *_PARTS)}
        return own | {"rng": self._rng.bit_generator.state, "choice": packed(self._choice)}

    def load_state_dict(self, state: Plain, sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; ValueError if it is none.  sides: T, C, device."""
        known, sides = self.known, {**(sides or {}), "d": self.known.axes.dim}
        own = {**_PLAIN, "rng": GENERATOR, "incumbent": maybe(instance(TrainingSample))}
        rest = dict.fromkeys((*_PARTS, "choice", "hypotheses", "descents"), anything)
        found = check(state, {**own, **rest}, dict(sides), "moves")
        parts: dict[str, Any] = {name: getattr(known, name) for name in _PARTS}
        parts["choice"] = self._choice
        if state["hypotheses"] is not None:
            parts["hypotheses"] = self._need_hypotheses()
        if state["descents"] is not None:
            parts["descents"] = self._need_descents()
        self._check(state)
        for name in _PLAIN:
            setattr(self, name, found[name])
        self._rng.bit_generator.state = state["rng"]
        for name, one in parts.items():
            one.load_state_dict(state[name], sides)
        known.incumbent = found["incumbent"]
        for optimum in known.optima.all:  # it is one of them, not a copy
            if known.incumbent is not None and np.array_equal(optimum.sample.x, known.incumbent.x):
                known.incumbent = optimum.sample

    def _check(self, state: Mapping[str, Any]) -> None:
        """Raise ValueError unless stage, move and incumbent fit together."""
        stage, move, moves = Stage(state["stage"]), state["move"], self.family
        descents = state["descents"]
        if stage is Stage.DESCENT and (
            self.descents is None or descents["round"] >= self.descents.rounds
        ):
            raise ValueError("moves['stage'] is 'descent', and no round is left")
        without = Stage.SEARCH, Stage.EXCHANGE, Stage.DESCENT
        if move not in moves and (move is not None or stage not in without):
            raise ValueError(f"moves['move'] is {move!r} in the stage {stage.value!r}")
        free = stage is Stage.DESCENT
        free = free or (stage is Stage.RESTART and not moves[move].from_incumbent)
        if stage is not Stage.SEARCH and not free and state["incumbent"] is None:
            raise ValueError(f"moves['incumbent'] is None in the stage {stage.value!r}")
        if stage is Stage.REMOVAL and state["exchangeability"]["blocks"] is None:
            raise ValueError("moves['exchangeability']['blocks'] is None while blocks are removed")
