"""Where to go on when a search has stalled: a family of moves, which `search.policy` chooses.

A local optimum, the *incumbent*, is mostly right.  A move proposes *restart candidates*, most of
them copies of it with some parameters changed; a search begins at the best of them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import ClassVar

import numpy as np
from torch import Tensor

from fide_plugins.population import TrainingSample
from fide_plugins.runtime.schema import array, flag, maybe, real, saved, whole
from fide_plugins.search.mixed import Axes, Values
from fide_plugins.search.scene import APART, Exchangeability, Optima, Removal, Sensitivity
from fide_plugins.types import Float64, Indices, Mask

AFTER_DESCENT = 0.01  # standard deviation of a search that follows descents, at most
WIDE, NARROW = 1 / 2, 1 / 8  # of sigma0: in the parameters that were moved, in all others


class Stage(StrEnum):
    """What the candidates of a generation are for."""

    SEARCH = "search"
    EXCHANGE = "exchange"
    REMOVAL = "removal"
    SENSITIVITY = "sensitivity"
    RESTART = "restart"
    DESCENT = "descent"


@dataclass(frozen=True, slots=True)
class Start:
    """Where a search begins.

    mean, std: (d,), of its first distribution.
    population, patience, improvement: population size, generations without progress that end it,
        and share of the loss that is progress, in units of the run's.
    strict_above: loss above which it has to be quick, see `one_search`; None: it may be slow.
    widest: mean standard deviation that it may come to, in units of that of its beginning.
    to_the_end: whether it goes on where other searches have collapsed, see `one_search`.
    fixed: (d,), axes that keep their coordinates in the mean during the search; None: none.
    """

    mean: Float64 = saved(array("d", low=0.0, high=1.0))
    std: Float64 = saved(array("d", low=0.0, high=1e6))
    population: int = saved(whole(1, 2**10), default=1)
    patience: int = saved(whole(1, 100), default=1)
    improvement: float = saved(real(0.0, 1.0), default=1.0)
    strict_above: float | None = saved(maybe(real()), default=None)
    widest: float = saved(real(1.0), default=1.0)
    to_the_end: bool = saved(flag, default=False)
    fixed: Mask | None = saved(maybe(array("d", kind="b")), default=None)


@dataclass(kw_only=True, slots=True)
class Known:
    """What is known of the scene and of its local optima; what was found is in `search.scene`.

    x0, sigma0: (d,), mean and standard deviation of the first search.
    target: (T, C), tokens of the target; channels: the leading ones in which images are compared.
    place: points of the cube (n, d) as they are rendered: integers and choices in their cells.
    incumbent: local optimum that moves leave; None before the first, and after a search began
        without images.
    blurs: whether searches that begin coarse are useful (`comparison.scale_space`).
    only_coarse: whether a search from a random place has to begin so.
    """

    x0: Float64
    sigma0: Float64
    target: Tensor
    channels: int | None
    exchangeability: Exchangeability
    sensitivity: Sensitivity
    axes: Axes
    removal: Removal = field(default_factory=Removal)
    place: Callable[[Float64], Float64] = np.copy
    incumbent: TrainingSample | None = None
    optima: Optima = field(default_factory=Optima)
    values: Values = field(default_factory=Values)
    blurs: bool = False
    only_coarse: bool = False

    @property
    def current(self) -> TrainingSample:
        """The incumbent, which must be there."""
        assert self.incumbent is not None
        return self.incumbent

    def began_apart(self, begun: Float64, ended: Float64) -> bool:
        """Whether a search that left the incumbent began apart from where it ended, (d,) each.

        Then it is evidence of where it ended.  More than half of all parameters must have been
        changed, and be apart: what keeps most of them, right or wrong, comes back to them.
        """
        axes = self.axes
        moved = np.unique(axes.parameter_of[begun != self.current.x])
        if 2 * len(moved) <= len(axes.axes_of):
            return False
        apart = axes.difference(begun, self.exchangeability.aligned(ended, begun))
        return all(apart[axes.axes_of[i]].max() >= APART for i in moved)

    def copies(self, n: int) -> Float64:
        """Copies (n, d) of the incumbent's parameters."""
        return np.tile(self.current.x, (n, 1))

    def start_at(self, x: Float64, wide: float = WIDE, narrow: float = NARROW) -> Start:
        """Start at x (d,): `wide` where it differs from the incumbent, in units of sigma0."""
        std = narrow * self.sigma0
        moved = self.axes.together(np.flatnonzero(x != self.current.x))
        std[moved] = wide * self.sigma0[moved]
        return Start(x, std)


class Move(ABC):
    """One way to leave a local optimum.

    name: by which it is chosen and saved.
    prior_gain: share by which it is expected to lower the loss, as long as it was not tried.
    from_incumbent: whether its gain is measured from the incumbent, and it is chosen by its gain
        (`policy.MoveChoice`); otherwise the policy says when it is due.
    has_goal: whether its search is over when it has no hope to become better than the incumbent.
    has_more: whether `draw` gives other candidates each time, which are as good as the first ones.
    with_blocks: whether it is for scenes with exchangeable blocks, or without; None: for both.
    wide: standard deviation in the parameters that were changed, in units of sigma0.
    """

    name: ClassVar[str]
    prior_gain: ClassVar[float] = 0.1
    from_incumbent: ClassVar[bool] = True
    has_goal: ClassVar[bool] = True
    has_more: ClassVar[bool] = True
    with_blocks: ClassVar[bool | None] = None
    wide: ClassVar[float] = WIDE

    def possible(self, known: Known) -> bool:
        """Whether the move applies to this scene, as far as is known."""
        return self.with_blocks in (None, known.exchangeability.blocks is not None)

    def needs(self, known: Known) -> Stage | None:
        """Stage that must come before the restart candidates; None if nothing is missing."""
        return None

    @abstractmethod
    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Draw restart candidates, (n, d) in [0, 1]; fewer where the move has no more."""

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Return where the search begins, given the best restart candidate x (d,).

        A move that does not go there twice notes it in `known`.
        """
        return known.start_at(x, self.wide)


class RelocateGroup(Move):
    """A group of parameters, by exchangeability or sensitivity, at a random place."""

    name = "relocate group"

    def needs(self, known: Known) -> Stage | None:
        """Sensitivity samples, once, where blocks are not known."""
        done = known.exchangeability.blocks is not None or known.sensitivity.rounds
        return None if done else Stage.SENSITIVITY

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of the incumbent, each with one group, by its size, uniform in the cube."""
        blocks, leftovers = known.exchangeability.blocks, known.exchangeability.leftovers
        groups = known.sensitivity.groups if blocks is None else [*blocks, leftovers]
        groups = [group for group in groups if len(group)]
        sizes = np.array([len(group) for group in groups])
        x = known.copies(n)
        for row, which in zip(x, rng.choice(len(groups), n, p=sizes / sizes.sum()), strict=True):
            row[groups[which]] = rng.random(sizes[which])
        return x


_SMALLEST, _LARGEST = 0.03, 0.5  # standard deviation of a difference, log-uniform


class Split(Move):
    """A redundant block becomes a copy of one that has too much to do.

    Local optima of exchangeable things have a known shape: several things of the scene stand for
    one of the target's, and one stands for several, as centers do in k-means (Qian et al. 2020,
    arXiv:2002.06694).  So the block that is cheapest to remove (`scene.Removal`) is put beside the
    one in whose region most of the error lies, with differences N(0, s^2), s log-uniform.
    """

    name = "split"
    prior_gain = 0.5
    with_blocks = True

    def needs(self, known: Known) -> Stage | None:
        """Removal costs of the incumbent."""
        return None if known.removal.known else Stage.REMOVAL

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of the incumbent with one block beside another.

        The donor is drawn by exp(-rank of its removal cost), the source in proportion to the
        residual in the tokens that it owns.
        """
        blocks = known.exchangeability.blocks
        assert blocks is not None
        removal = known.removal
        rank = np.argsort(np.argsort(removal.costs, kind="stable"), kind="stable")
        cheap = np.exp(-rank.astype(np.float64))
        residual = removal.residual(known.current, known.target, known.channels) + 1e-300
        x = known.copies(n)
        spread = np.exp(rng.uniform(np.log(_SMALLEST), np.log(_LARGEST), (n, blocks.shape[1])))
        jitter = spread * rng.standard_normal((n, blocks.shape[1]))
        for row, difference in zip(x, jitter, strict=True):
            donor = rng.choice(len(blocks), p=cheap / cheap.sum())
            weight = residual.copy()
            weight[donor] = 0.0
            source = rng.choice(len(blocks), p=weight / weight.sum())
            row[blocks[donor]] = row[blocks[source]] + difference
        return known.axes.inside(x)


class RelocateSegment(Move):
    """A segment of neighboring parameters, up to half of all, at a random place.

    That is for scenes in which nothing says what belongs together: joints that all move the hand.
    """

    name = "relocate segment"
    with_blocks = False

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of the incumbent, each with one segment uniform in the unit cube."""
        x = known.copies(n)
        for row in x:
            chosen = known.axes.together(segment(known.axes.dim, rng))
            row[chosen] = rng.random(len(chosen))
        return x


def segment(dim: int, rng: np.random.Generator) -> Indices:
    """Draw neighboring parameters: a length log-uniform in [1, d / 2], any place."""
    length = int(np.exp(rng.uniform(0.0, np.log(dim // 2 + 1))))
    start = int(rng.integers(0, dim - length + 1))
    return np.arange(start, start + length)


_REPLACED = 0.4  # of the candidates have a new part, the others another order
_NEW = 0.15  # standard deviation of a new part, from between its neighbors


class Rearrange(Move):
    """Parts of a chain in another order, or one of them taken out and put in elsewhere.

    A local optimum, of a curve for instance, covers much of the picture in a wrong order, or has
    too many parts in one place and none in another.  So some neighbors are reversed (2-opt; Croes
    1958) or rotated, or one part is dropped, and a new one comes between two others or beyond the
    first or the last one, near where the chain goes.
    """

    name = "rearrange"
    prior_gain = 0.5

    def possible(self, known: Known) -> bool:
        """Whether there is a chain, and no blocks are exchangeable: their order is nothing."""
        return known.exchangeability.chain is not None and known.exchangeability.blocks is None

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of the incumbent, each with its parts rearranged."""
        chain, x = known.exchangeability.chain, known.copies(n)
        assert chain is not None
        for row in x:
            change = _replaced if rng.random() < _REPLACED else _reordered
            row[chain] = change(row[chain], rng)
        return known.axes.inside(x)


def _reordered(parts: Float64, rng: np.random.Generator) -> Float64:
    """Parts (n, q) of which some neighbors are reversed or rotated."""
    length = int(rng.integers(2, len(parts) + 1))
    first = int(rng.integers(0, len(parts) - length + 1))
    chosen = slice(first, first + length)
    turn = int(rng.integers(1, length)) if rng.random() < 1 / 2 else 0
    parts = parts.copy()
    parts[chosen] = np.roll(parts[chosen], turn, axis=0) if turn else parts[chosen][::-1]
    return parts


def _replaced(parts: Float64, rng: np.random.Generator) -> Float64:
    """Parts (n, q) of which one is new: between two others, or beyond the first or the last."""
    left = np.delete(parts, int(rng.integers(len(parts))), axis=0)
    place = int(rng.integers(len(parts)))
    beyond = np.concatenate([2 * left[:1] - left[1:2], left, 2 * left[-1:] - left[-2:-1]])
    ends = place in (0, len(left))
    new = beyond[0 if not place else -1] if ends else (left[place - 1] + left[place]) / 2
    return np.insert(left, place, new + _NEW * rng.standard_normal(parts.shape[1]), axis=0)


_LONGEST = 0.58  # half a turn in units of the box, for a range of 310 degrees


class HalfTurn(Move):
    """Angles that look alike: one to three neighbors, half a turn away, mirrored, or both.

    A rotation has two descriptions by three angles, (a, b, c) and (a + 180°, -b, c + 180°) (Diebel
    2006, *Representing Attitude*, section 5).  Nobody has said which parameters are angles: a range
    is mostly one turn or a little less, with zero in the middle, so half a turn is half of the box
    or a little more, and the sign changes by a reflection about the center.
    """

    name = "half turn"
    with_blocks = False
    wide = 1 / 4  # the ranges of the angles are a guess

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of the incumbent, each with some neighbors turned."""
        angles, periodic = known.axes.continuous, known.axes.periodic
        x = known.copies(n)
        for row in x:
            length = int(rng.integers(1, min(3, len(angles)) + 1))
            first = int(rng.integers(0, len(angles) - length + 1))
            mirrored = 1 if length == 3 else int(rng.integers(0, 2))
            for i, axis in enumerate(angles[first : first + length]):
                if i % 2 == mirrored:
                    row[axis] = 1.0 - row[axis]
                else:
                    exact = periodic is not None and periodic[axis]
                    half = 0.5 if exact else float(rng.uniform(0.5, _LONGEST))
                    row[axis] += (1.0 if row[axis] < 0.5 else -1.0) * half
        return known.axes.inside(x)


_VALUE_WIDTH = 1 / 4  # of sigma0, in numbers: they adapt to the value


class ChangeValue(Move):
    """The incumbent with another value of one integer or choice."""

    name = "change value"
    prior_gain = 0.5
    has_more = False

    def possible(self, known: Known) -> bool:
        """Whether an integer or a choice has another value."""
        return len(known.values.others(known.current.x)) > 0

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n or fewer, d) of the incumbent, with values that were searched least often."""
        others = known.values.others(known.current.x)
        searches = known.values.searches(others)
        least = others[searches == searches.min()]
        return least if len(least) <= n else rng.permutation(least)[:n]

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Hold the value that was changed; be narrow in all others, and wider in numbers."""
        known.values.note(x)
        width = np.where(known.values.discrete, NARROW, _VALUE_WIDTH)
        fixed = np.zeros(known.axes.dim, bool)
        fixed[known.axes.together(np.flatnonzero(x != known.current.x))] = True
        fixed &= known.values.discrete  # x may be another point of the user's, with other numbers
        return Start(x, width * known.sigma0, fixed=fixed)


_REACH = 3.0  # standard deviations
_RESTARTS_WIDTH = 0.6  # of sigma0, around the best of the random places
_MOST_DOUBLINGS = 6


class RandomRestart(Move):
    """A new search from a random place, at most three standard deviations from the first one.

    Where images guide the search, the best of some random places is where it begins.  By losses
    only it is CMA-ES with two kinds of restarts in turn (after BIPOP; Hansen 2009): populations
    that double, and small ones with narrow beginnings.
    """

    name = "random restart"
    from_incumbent = False
    has_goal = False

    def possible(self, known: Known) -> bool:
        """Return True, unless it has to begin coarse: that is a move of its own."""
        return not known.only_coarse

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Draw n random places, (n, d); periodic parameters have no walls."""
        low, high = known.x0 - _REACH * known.sigma0, known.x0 + _REACH * known.sigma0
        clipped = np.clip(low, 0.0, 1.0), np.clip(high, 0.0, 1.0)
        if known.axes.periodic is None:
            return rng.uniform(*clipped, (n, known.axes.dim))
        around = np.maximum(low, known.x0 - 0.5), np.minimum(high, known.x0 + 0.5)
        low, high = np.where(known.axes.periodic, around, clipped)
        return known.axes.inside(rng.uniform(low, high, (n, known.axes.dim)))

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Begin around one of them."""
        return Start(x, _RESTARTS_WIDTH * known.sigma0)

    def start_without_images(self, known: Known, number: int, rng: np.random.Generator) -> Start:
        """Begin a search by losses only, the `number`-th, from 1.

        Odd ones double the population; even ones have the first population and a narrow beginning,
        and may become as wide as the first search, since the answer may be far away.
        """
        mean = self.draw(known, 1, rng)[0]
        if number % 2:
            return Start(mean, known.sigma0, 2 ** min((number + 1) // 2, _MOST_DOUBLINGS))
        widest = 10.0 ** (2.0 * rng.random())
        return Start(mean, known.sigma0 / widest, widest=widest)


class Coarsen(RandomRestart):
    """A new search from a random place that begins coarse: chosen by its gains, as moves are."""

    name = "coarsen"
    prior_gain = 0.3
    from_incumbent = True  # measured from there
    has_goal = True

    def possible(self, known: Known) -> bool:
        """Whether searches that begin coarse are useful."""
        return known.blurs

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Begin around the best of them, as wide as the first search."""
        return Start(x, known.sigma0.copy())


_NARROW = 1 / 30  # of sigma0
_PATIENCE = 3  # times that of other searches


class Refine(Move):
    """The incumbent itself, searched closely, once: it may not have been at the end of its search.

    A search is over soon, so that the next move can begin.  This move goes on with more patience
    and a narrow distribution, once an optimum has been left in vain, or at once where a hypothesis
    has led to the right place.
    """

    name = "refine"
    has_goal = False  # it begins behind the loss of the incumbent, and needs time to come back

    def possible(self, known: Known) -> bool:
        """Whether the incumbent was left in vain, and was not refined yet."""
        optimum = known.optima.of(known.current)
        return optimum is not None and optimum.failures > 0 and not optimum.refined

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Neighbors (n, d) of the incumbent."""
        x = known.copies(n)
        return known.axes.inside(x + _NARROW * known.sigma0 * rng.standard_normal(x.shape))

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Begin at the incumbent, which is not refined again."""
        optimum = known.optima.of(known.current)
        if optimum is not None:
            optimum.refined = True
        width = _NARROW * known.sigma0
        return Start(known.current.x, width, patience=_PATIENCE, to_the_end=True)
