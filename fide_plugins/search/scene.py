"""What has been found out about the scene: its parameters, and its local optima (`moves.Known`).

Nothing in this module knows a move.
"""

from __future__ import annotations

import operator
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import numpy as np
from torch import Tensor

from fide_plugins.errors import OptionError
from fide_plugins.population import TrainingSample
from fide_plugins.runtime.schema import (
    Plain,
    Schema,
    Sides,
    Stateful,
    anything,
    array,
    check,
    each,
    flag,
    instance,
    maybe,
    saved,
    whole,
)
from fide_plugins.search import mixed
from fide_plugins.search.mixed import Axes
from fide_plugins.types import Float64, Indices

# -- exchangeable blocks ---------------------------------------------------------------------------

_MOST_LAYOUTS = 24  # layouts tested in a round
_LONGEST = 12  # blocks that are tested at the ends
_REPEATS = 2  # renders of the local optimum itself
_NOISE = 3.0  # times the noise that a change may have
_SEEN = 3.0  # times as much again that a control must change
_ROUNDING = 1e-8  # of the change by a permutation: what rounding may change
_LITTLE = 0.15  # of that change: what an order of painting may change
_EQUAL = 2.0  # times the least change: layouts that hold as well
_PART_SIZES, _MOST_LEFT = (2, 3), 3  # of chains: parameters of a part; leftovers, at the end
_SHORTEST = 3  # parts of a chain
_SEAMS = 1e-3  # of the change by a permutation: what the other direction of a chain may change
_FINISHED = 3  # rounds
_DECLARED = 4  # nothing is to be found; repeats say what noise is


def check_groups(groups: Sequence[Sequence[int]], dim: int) -> Indices:
    """Return declared exchangeable groups as a layout (n, L); raises OptionError."""
    try:
        lists = [[operator.index(i) for i in group] for group in groups]
    except TypeError:
        lists = []
    numbers = [i for group in lists for i in group]
    sound = len(lists) >= 2 and len({len(group) for group in lists}) == 1 and numbers
    if not sound or len(set(numbers)) < len(numbers) or not set(numbers) <= set(range(dim)):
        raise OptionError(
            "groups must be at least two lists of parameter numbers, all of one length, without "
            f"overlap, each number from 0 to {dim - 1}; got {groups!r}"
        )
    return np.array(lists, np.intp)


class Exchangeability(Stateful):
    """Layout of exchangeable blocks, and the tests that find it.

    A *layout* says which parameters form which block: indices (n, L), n blocks of length L;
    contiguous, or strided (one parameter of all blocks, then the next), with or without leftovers.

    The tests are renders of a local optimum with its blocks rotated by one place, which moves every
    block, and changes the order of one only.  A layout holds if the image changes by no more than
    noise does, which is measured by renders of the local optimum itself, or by little of what a
    random permutation of the parameters changes.  Three rounds: layouts without leftovers, for
    every divisor L of d; if none holds, the first two and the last two blocks of every length; if
    one of these holds, each further block against the first.

    Parts of a *chain*, such as control points of a curve, show the same image in reverse order, and
    in no other one.  Chains are tested in the second round.

    axes: of the cube.
    channels: leading channels of the tokens in which images are compared; None: all.
    groups: declared blocks; None: to be found; empty: there are none.
    blocks: layout (n, L); None where none is known.
    chain: layout of its parts, the same; None where none is known.
    ordered: whether the order of blocks shows a little, as painting does.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "round": whole(0, _DECLARED),
        "ordered": flag,
        "blocks": anything,
        "chain": anything,
        "found": anything,
    }

    def __init__(
        self,
        axes: Axes,
        channels: int | None,
        groups: Sequence[Sequence[int]] | None = None,
    ) -> None:
        self._axes, self.dim, self.channels = axes, axes.dim, channels
        self.blocks: Indices | None = None
        self.chain: Indices | None = None
        self.ordered = False
        self._round = 0
        self._found: Indices | None = None  # tested closely: a pair, or all blocks
        if groups is not None:
            self._round = _DECLARED
            if len(groups):
                self.blocks, self.ordered = check_groups(groups, self.dim), True

    @property
    def finished(self) -> bool:
        """Whether there is nothing more to test."""
        return self._round == _FINISHED

    @property
    def leftovers(self) -> Indices:
        """Parameters that are in no block."""
        used = [] if self.blocks is None else self.blocks.ravel().tolist()
        return np.setdiff1d(np.arange(self.dim), np.array(used, np.intp))

    def distance(self, x: Float64, y: Float64, enough: float = np.inf) -> float:
        """Largest difference of a parameter of x and y, (d,) each, blocks in the best order.

        That is the order with the least sum of the blocks' largest differences.  Where it is seen
        at once that the distance is `enough`, less than all of it may be returned.
        """
        difference = self._axes.difference(x, y)
        if self.blocks is None:
            return float(difference.max())
        costs = self._costs(x, y)
        least = float(costs.min(axis=1).max())
        if least >= enough:
            return least
        matched = costs[_matched(costs)].max()
        return float(max(matched, difference[self.leftovers].max(initial=0.0)))

    def aligned(self, x: Float64, y: Float64) -> Float64:
        """Copy of x (d,) with its blocks in the order that is nearest to y (d,), see `distance`."""
        aligned = x.copy()
        if self.blocks is not None:
            rows, places = _matched(self._costs(x, y))
            aligned[self.blocks[places]] = x[self.blocks[rows]]
        return aligned

    def _costs(self, x: Float64, y: Float64) -> Float64:
        """Largest differences (n, n) of each block of x from each of y."""
        assert self.blocks is not None
        blocks = self.blocks
        costs: Float64 = self._axes.difference(x[blocks][:, None], y[blocks], blocks).max(axis=2)
        return costs

    def draw(self, x: Float64) -> Float64:
        """Candidates (n, d) that test the local optimum x (d,): repeats, a control, and layouts.

        Where blocks are declared there are only the repeats: the policy learns the noise from them.
        """
        if self._round == _DECLARED:
            return np.stack([x] * _REPEATS)
        control = x[np.random.default_rng(self.dim).permutation(self.dim)]
        if self._found is not None:  # as far as the exchange of the pair, the other way
            control = mixed.into(2 * x - _rotated(x, self._found))
        rotated = [_rotated(x, layout) for layout in self._layouts()]
        reverse = [_reversed(x, layout) for layout in self._chains()]
        return np.stack([*[x] * _REPEATS, control, *rotated, *reverse])

    def learn(
        self,
        incumbent: TrainingSample,
        samples: Sequence[TrainingSample],
        place: Callable[[Float64], Float64] = np.copy,
    ) -> None:
        """Learn from the renders of what `draw` gave for the incumbent; some may be missing.

        place: what became of these points before they were rendered.
        """
        if self._round == _DECLARED:
            self._round = _FINISHED
            return
        plan, layouts = place(self.draw(incumbent.x)), self._layouts()
        changes = _changes(plan, incumbent, samples, self.channels)
        noise, control, tests = _NOISE * changes[0], changes[_REPEATS], changes[_REPEATS + 1 :]
        equal = (plan[_REPEATS + 1 :] == incumbent.x).all(axis=1)  # such a test says nothing
        tests = np.where(equal, np.inf, tests)
        tests, reverse = np.split(tests, [len(layouts)])
        exact = noise + _ROUNDING * control
        painted = self._round == 0 or (self._found is not None and self._found.size == self.dim)
        bound = exact + (_LITTLE * control if painted else 0.0)
        seen = bool(np.isfinite(control) and control > _SEEN * noise)
        holds = (tests <= bound) & seen
        if len(reverse) and seen and reverse.min() <= exact + _SEAMS * control:
            self.chain = self._chains()[int(reverse.argmin())]
        self._round += 1
        if self._round == _FINISHED:
            assert self._found is not None
            members = [layout[1:] for layout, held in zip(layouts, holds, strict=True) if held]
            if len(members):
                self.blocks = np.concatenate([self._found[:1], *members])
            self.ordered = self.ordered and self.blocks is not None
        elif holds.any():  # the shortest among those that hold best
            best = max(exact, _EQUAL * float(tests[holds].min()))
            which = np.flatnonzero(holds & (tests <= best))
            layout = min((layouts[i] for i in which), key=lambda layout: layout.shape[1])
            self.ordered = bool(tests[holds].min() > exact)
            if self._round == 1 and not self.ordered:
                self.blocks, self._round = layout, _FINISHED
            else:
                self._found, self._round = layout, 2
        elif self._round == 2:
            self._round = _FINISHED

    def _layouts(self) -> list[Indices]:
        """Layouts that the present round tests: of none is a parameter's axis outside its block."""
        dim, found, every = self.dim, self._found, np.arange(self.dim)
        layouts: list[Indices] = []
        if self._round == 0:  # without leftovers, shortest blocks first
            for length in (n for n in range(1, dim // 2 + 1) if dim % n == 0):
                layouts.append(every.reshape(-1, length))
                if length > 1:
                    layouts.append(every.reshape(length, -1).T)
        elif self._round == 1:  # pairs of blocks at the beginning and at the end
            for length in range(1, min(_LONGEST, dim // 2) + 1):
                layouts.append(every[: 2 * length].reshape(2, length))
                layouts.append(every[dim - 2 * length :].reshape(2, length))
        elif found is not None and found.size == dim:
            return [found]
        elif found is not None:  # the first block of two and each other, by their distance
            length = found.shape[1]
            starts = range(0, dim - length + 1, length)
            if found[0, 0] != 0:
                starts = range(dim - length, -1, -length)
            pairs = [np.stack([found[0], every[start : start + length]]) for start in starts]
            layouts = [pair for pair in pairs if pair[1, 0] != found[0, 0]]
        most = len(layouts) if self._round == 2 else _MOST_LAYOUTS
        together = self._axes.together
        return [
            layout
            for layout in layouts[:most]
            if all(len(together(block)) == len(block) for block in layout)
        ]

    def _chains(self) -> list[Indices]:
        """Layouts of chains that the present round tests, which end before the leftovers."""
        if self._round != 1:
            return []
        shapes = ((n, self.dim - left) for n in _PART_SIZES for left in range(_MOST_LEFT + 1))
        return [
            np.arange(used).reshape(-1, n)
            for n, used in shapes
            if used % n == 0 and used >= _SHORTEST * n
        ]

    def load_state_dict(self, state: Plain, sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; ValueError for what it cannot have given."""
        for name in ("blocks", "chain", "found"):
            within = maybe(array(name, "length", kind="i", low=0, high=self.dim - 1))
            check(state[name], within, {}, f"exchangeability[{name!r}]")
        if state["round"] == 2 and state["found"] is None:
            raise ValueError("exchangeability['found'] is None, and blocks are tested against it")
        super().load_state_dict(state)


def _matched(costs: Float64) -> tuple[Indices, Indices]:
    """Rows and columns of the assignment with the least sum of costs (n, n)."""
    nearest = costs.argmin(axis=1)
    if len(np.unique(nearest)) == len(costs):  # of each the nearest, which no other has
        return np.arange(len(costs)), nearest
    from scipy.optimize import linear_sum_assignment  # takes a tenth of a second

    return linear_sum_assignment(costs)  # type: ignore[no-any-return]


def _rotated(x: Float64, layout: Indices) -> Float64:
    """Copy of x (d,) in which each block has the values of the next one."""
    y = x.copy()
    y[layout] = x[np.roll(layout, -1, axis=0)]
    return y


def _reversed(x: Float64, layout: Indices) -> Float64:
    """Copy of x (d,) with its blocks in reverse order."""
    y = x.copy()
    y[layout] = x[layout[::-1]]
    return y


def _changes(
    plan: Float64,
    incumbent: TrainingSample,
    samples: Sequence[TrainingSample],
    channels: int | None,
) -> Float64:
    """Mean squared change (n,) of tokens by each row of the plan; +inf where it is missing.

    Measured from the first repeat of the incumbent; those of its other images are noise.
    """
    images: dict[bytes, list[Tensor]] = defaultdict(list)
    for sample in samples:
        images[sample.x.tobytes()].append(sample.tokens)
    repeats = [*images[incumbent.x.tobytes()], incumbent.tokens]
    first = repeats[0][:, :channels].double()
    changes = np.full(len(plan), np.inf)
    for i, point in enumerate(plan):
        seen = repeats[1:] if i < _REPEATS else images[point.tobytes()]
        if seen:
            changes[i] = max(
                float((tokens[:, :channels].double() - first).square().mean()) for tokens in seen
            )
    return changes


# -- what a block or a parameter changes -----------------------------------------------------------

_LARGEST_COST = 1e300


@dataclass(eq=False)
class Removal(Stateful):
    """What each exchangeable block of one incumbent contributes to the image; one render a block.

    Block i is overwritten by a copy of another block.  Where blocks are exchangeable, and two in
    one place look like one, that deletes block i: the loss that it costs is its *removal cost*, and
    the tokens that change are the region that it *owns*.

    costs: (n,).  owned: (n, T); both are empty before a round.
    """

    costs: Float64 = saved(array("blocks"), default_factory=lambda: np.empty(0))
    owned: Float64 = saved(
        array("blocks", "tokens", low=0.0), default_factory=lambda: np.empty((0, 0))
    )

    @property
    def known(self) -> bool:
        """Whether there was a round for the incumbent."""
        return len(self.costs) > 0

    def draw(self, x: Float64, blocks: Indices, rng: np.random.Generator) -> Float64:
        """Copies (n, d) of x (d,), each with one block overwritten by another one."""
        n = len(blocks)
        other = (np.arange(n) + rng.integers(1, n, size=n)) % n
        removed = np.tile(x, (n, 1))
        for one, block, copied in zip(removed, blocks, blocks[other], strict=True):
            one[block] = x[copied]
        return removed

    def learn(
        self,
        incumbent: TrainingSample,
        samples: Sequence[TrainingSample],
        blocks: Indices,
        channels: int | None,
    ) -> None:
        """Learn from renders of what `draw` gave; a block without one costs nothing."""
        self.costs = np.zeros(len(blocks))
        self.owned = np.zeros((len(blocks), len(incumbent.tokens)))
        for sample in samples:
            moved = sample.x != incumbent.x
            touched = np.flatnonzero(moved[blocks].any(axis=1))
            if len(touched) == 1 and moved.sum() == moved[blocks[touched[0]]].sum():
                cost = np.clip(sample.loss - incumbent.loss, -_LARGEST_COST, _LARGEST_COST)
                self.costs[touched[0]] = cost
                self.owned[touched[0]] = changed(incumbent.tokens, sample.tokens, channels)

    def residual(self, incumbent: TrainingSample, target: Tensor, channels: int | None) -> Float64:
        """Squared error of the image in the tokens that each block owns, (n,)."""
        error = changed(incumbent.tokens, target, channels) ** 2  # (T,)
        part = self.owned**2
        part = part / np.maximum(part.sum(axis=0), 1e-300)
        owned: Float64 = part @ error
        return owned


def changed(before: Tensor, after: Tensor, channels: int | None) -> Float64:
    """How much each of the T tokens differs, (T,), Euclidean."""
    difference = (after.to(before.device) - before)[:, :channels].double()
    return np.asarray(difference.square().sum(dim=1).sqrt().cpu().numpy(), np.float64)


_SIZE_POWER = 1.5  # of the number of parameters in the worth of a branch; measured


def overlaps(changes: Float64) -> Float64:
    """Overlap coefficients (n, n) (Simpson 1943) of changes (n, T) >= 0.

    O_ij = sum_t min(A_it, A_jt) / min(sum_t A_it, sum_t A_jt) is 1 when what the weaker one
    changes, the stronger one changes too: a color changes the whole cell, a coordinate its border
    only.  A parameter that changes nothing overlaps with nothing.
    """
    total = changes.sum(axis=1)
    shared = np.array([np.minimum(one, changes).sum(axis=1) for one in changes])
    smaller = np.minimum(total[:, None], total)
    overlap: Float64 = np.divide(shared, smaller, out=np.zeros_like(shared), where=smaller > 0)
    return np.clip(overlap, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class _Branch:
    """A node of the dendrogram: its members, the height at which it forms, its best division."""

    members: list[int]
    height: float
    parts: list[list[int]]
    worth: float

    def closed(self, joins_at: float) -> _Branch:
        """Return the branch when it is known where it ends: one part, if that is worth as much."""
        whole = max(joins_at - self.height, 0.0) * len(self.members) ** _SIZE_POWER
        if whole < self.worth:
            return self
        return _Branch(self.members, self.height, [self.members], whole)


def find_parts(overlap: Float64) -> list[Indices]:
    """Divide n parameters into parts, each an array of indices, by their overlap (n, n).

    Parts are read from a dendrogram of 1 - O by the excess of mass, as in HDBSCAN (Campello et al.
    2015, sec. 5): a branch is one part if it lasts longer, from the height at which it forms to the
    height at which it joins another, than its own branches do together.  All parameters together
    are never one part: moving them all is what a restart does.
    """
    from scipy.cluster.hierarchy import linkage
    from scipy.spatial.distance import squareform

    n = len(overlap)
    branches = [_Branch([i], 0.0, [[i]], 0.0) for i in range(n)]
    if n == 1:
        return [np.array([0])]
    distance = 1.0 - (overlap + overlap.T) / 2
    np.fill_diagonal(distance, 0.0)
    for a, b, height, _ in linkage(squareform(distance, checks=False), "average"):
        left, right = branches[int(a)].closed(height), branches[int(b)].closed(height)
        members, parts = left.members + right.members, left.parts + right.parts
        branches.append(_Branch(members, height, parts, left.worth + right.worth))
    return [np.array(sorted(part)) for part in branches[-1].parts]


class Sensitivity(Stateful):
    """Groups of parameters that change the same places of the image.

    Each parameter of the incumbent is moved, alone, to a random value: one render each.  The
    overlap of what they change says which form a group.  That depends on the renderer more than on
    the candidate: one round serves for all incumbents.

    axes: of the cube; those of one parameter, such as a choice, are moved together.
    channels: leading channels of the tokens in which changes are seen; None: all.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "rounds": whole(),
        "overlap": array("p", "p", low=0.0),
        "pairs": array("p", "p", low=0.0),
    }

    def __init__(self, axes: Axes, channels: int | None) -> None:
        self._axes, self.dim, self.channels = axes, axes.dim, channels
        p = len(axes.axes_of)
        self.rounds = 0
        self._overlap = np.zeros((p, p))  # sum over all samples
        self._pairs = np.zeros((p, p))  # how often each pair was seen together

    def draw(self, x: Float64, rng: np.random.Generator) -> Float64:
        """Copies (p, d) of x (d,), each with one parameter at a random value."""
        samples = np.tile(x, (len(self._axes.axes_of), 1))
        samples[self._axes.parameter_of, np.arange(self.dim)] = rng.random(self.dim)
        return samples

    def learn(self, incumbent: TrainingSample, samples: Sequence[TrainingSample]) -> None:
        """Learn from renders of what `draw` gave; others, and missing ones, do no harm."""
        parameter_of = self._axes.parameter_of
        moved = [np.unique(parameter_of[sample.x != incumbent.x]) for sample in samples]
        single = [(int(m[0]), s) for m, s in zip(moved, samples, strict=True) if len(m) == 1]
        self.rounds += 1
        if not single:
            return
        which = np.array([i for i, _ in single])
        changes = [changed(incumbent.tokens, s.tokens, self.channels) for _, s in single]
        self._overlap, self._pairs = self._overlap.copy(), self._pairs.copy()
        np.add.at(self._overlap, np.ix_(which, which), overlaps(np.array(changes)))
        np.add.at(self._pairs, np.ix_(which, which), 1.0)

    @property
    def groups(self) -> list[Indices]:
        """Axes of parameters that belong together, as far as is known."""
        parts = find_parts(self._overlap / np.maximum(self._pairs, 1.0))
        return [np.concatenate([self._axes.axes_of[i] for i in part]) for part in parts]

    def _sides(self) -> Sides:
        return {"p": len(self._axes.axes_of)}


# -- local optima ----------------------------------------------------------------------------------

Distance: TypeAlias = Callable[..., float]
"""Of two points (d,), as `Exchangeability.distance`."""

_MOST = 12  # optima that are remembered
APART = 0.05  # of the unit cube, in some parameter, that makes two optima distinct
_NEW, _NEW_AGAIN = 1.0, 0.5  # score of the first new search; added by each without a success


@dataclass(slots=True)
class Optimum:
    """A local optimum.

    failures: of moves from it.
    searches: that ended there and had begun apart from it; no move is chosen by them.
    refined: whether `refine` was tried.
    """

    sample: TrainingSample = saved(instance(TrainingSample))
    failures: int = saved(whole(), default=0)
    searches: int = saved(whole(), default=1)
    refined: bool = saved(flag, default=False)


@dataclass(eq=False)
class Optima(Stateful):
    """Distinct local optima, best first, and how often moves from each of them failed.

    The next incumbent is the optimum with the lowest *score*, its rank by loss plus its failures in
    units of a tolerance.  A new search is due when its own score is lower still.

    forgotten: searches that ended in places which are no longer remembered.
    descents: new searches since the best optimum was found.
    """

    all: list[Optimum] = saved(each(instance(Optimum)), default_factory=list)
    descents: int = saved(whole(), default=0)
    forgotten: int = saved(whole(), default=0)

    def note(self, found: TrainingSample, distance: Distance, *, began_apart: bool = True) -> bool:
        """Note where a search ended; returns whether that is the best optimum so far.

        distance: of two points (d,), in units of the unit cube.
        began_apart: whether the search had begun apart from there.
        """
        best = not self.all or found.loss < self.all[0].sample.loss
        if best:
            self.descents = 0
        close = [o for o in self.all if distance(o.sample.x, found.x, APART) < APART]
        searches = int(began_apart) + sum(optimum.searches for optimum in close)
        if close and close[0].sample.loss <= found.loss:
            close[0].searches += int(began_apart)
            return False
        self.all = [optimum for optimum in self.all if optimum not in close]
        self.all.append(Optimum(found, searches=searches))
        self.all.sort(key=lambda optimum: optimum.sample.loss)
        self.forgotten += sum(optimum.searches for optimum in self.all[_MOST:])
        del self.all[_MOST:]
        return best

    def others(self, distance: Distance) -> tuple[float | None, float]:
        """How far the answers of searches differ that ended in other places than the best.

        Their lowest loss, None without any, and the largest distance of one from the best place.
        Those count that had begun apart from where they ended.
        """
        found = [optimum.sample for optimum in self.all[1:] if optimum.searches]
        if not found:
            return None, 0.0
        best = self.all[0].sample.x
        return found[0].loss, max(distance(best, one.x) for one in found)

    def of(self, sample: TrainingSample) -> Optimum | None:
        """Return the optimum with this sample, if it is remembered."""
        return next((optimum for optimum in self.all if optimum.sample is sample), None)

    def fail(self, incumbent: TrainingSample) -> None:
        """Note that a move from this optimum failed."""
        optimum = self.of(incumbent)
        if optimum is not None:
            optimum.failures += 1

    def next(self, tolerance: float) -> TrainingSample | None:
        """Return the optimum that is tried next; None: it is time for a new search.

        tolerance: failures that outweigh one rank.
        """
        scores = [rank + one.failures / tolerance for rank, one in enumerate(self.all)]
        if not scores or min(scores) >= _NEW + _NEW_AGAIN * self.descents:
            self.descents += 1
            return None
        return self.all[int(np.argmin(scores))].sample
