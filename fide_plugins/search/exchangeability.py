"""Which blocks of parameters are interchangeable: found by a few renders, or declared.

A *layout* says which parameters form which block: indices (n, L), n blocks of length L; contiguous,
or strided (one parameter of all blocks, then the next), with or without leftovers.
"""

from __future__ import annotations

import operator
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from torch import Tensor

from fide_plugins.errors import OptionError
from fide_plugins.population.candidate import TrainingSample
from fide_plugins.runtime.schema import (
    Schema,
    Sides,
    Stateful,
    anything,
    array,
    check,
    flag,
    maybe,
    whole,
)
from fide_plugins.search import mixed
from fide_plugins.search.scene import Axes
from fide_plugins.types import Float64, Indices, Mask

_MOST = 24  # layouts tested in a round
_LONGEST = 12  # blocks that are tested at the ends
_REPEATS = 2  # renders of the local optimum itself
_NOISE = 3.0  # times the noise that a change may have
_SEEN = 3.0  # times as much again that a control must change
_ROUNDING = 1e-8  # of the change by a permutation: what rounding may change
_LITTLE = 0.15  # of that change: what an order of painting may change
_EQUAL = 2.0  # times the least change: layouts that hold as well
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

    The tests are renders of a local optimum with its blocks rotated by one place, which moves every
    block, and changes the order of one only.  A layout holds if the image changes by no more than
    noise does, which is measured by renders of the local optimum itself, or by little of what a
    random permutation of the parameters changes.  Three rounds: layouts without leftovers, for
    every divisor L of d; if none holds, the first two and the last two blocks of every length; if
    one of these holds, each further block against the first.

    dim: d.
    channels: leading channels of the tokens in which images are compared; None: all.
    groups: declared blocks; None: to be found; empty: there are none.
    axes: which of them are one parameter or periodic; None: each is a parameter with walls.
    blocks: layout (n, L); None where none is known.
    ordered: whether the order of blocks shows a little, as painting does.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "round": whole(0, _DECLARED),
        "ordered": flag,
        "blocks": anything,
        "found": anything,
    }

    def __init__(
        self,
        dim: int,
        channels: int | None,
        groups: Sequence[Sequence[int]] | None = None,
        axes: Axes | None = None,
    ) -> None:
        self.dim, self.channels = dim, channels
        self._axes = axes or Axes(dim)
        self.blocks: Indices | None = None
        self.ordered = False
        self._round = 0
        self._found: Indices | None = None  # tested closely: a pair, or all blocks
        if groups is not None:
            self._round = _DECLARED
            if len(groups):
                self.blocks, self.ordered = check_groups(groups, dim), True

    @property
    def finished(self) -> bool:
        """Whether there is nothing more to test."""
        return self._round == _FINISHED

    @property
    def leftovers(self) -> Indices:
        """Parameters that are in no block."""
        used = [] if self.blocks is None else self.blocks.ravel().tolist()
        return np.setdiff1d(np.arange(self.dim), np.array(used, np.intp))

    def distance(self, x: Float64, y: Float64) -> float:
        """Largest difference of a parameter of x and y, (d,) each, blocks in the best order.

        That is the order with the least sum of the blocks' largest differences.
        """
        difference = self._axes.difference(x, y)
        if self.blocks is None:
            return float(difference.max())
        costs = self._costs(x, y)
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
        return np.stack([*[x] * _REPEATS, control, *rotated])

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
        plan = place(self.draw(incumbent.x))
        changes = _changes(plan, incumbent, samples, self.channels)
        noise, control, tests = _NOISE * changes[0], changes[_REPEATS], changes[_REPEATS + 1 :]
        equal = (plan[_REPEATS + 1 :] == incumbent.x).all(axis=1)  # such a test says nothing
        exact = noise + _ROUNDING * control
        painted = self._round == 0 or self._is_whole
        bound = exact + (_LITTLE * control if painted else 0.0)
        seen = bool(np.isfinite(control) and control > _SEEN * noise)
        holds = (tests <= bound) & ~equal & seen
        self._conclude(self._layouts(), tests, holds, exact)

    def _conclude(
        self, layouts: list[Indices], changes: Float64, holds: Mask, exact: float
    ) -> None:
        """Take the shortest layout among those that hold best; go to the next round."""
        self._round += 1
        if self._round == _FINISHED:
            assert self._found is not None
            members = [layout[1:] for layout, held in zip(layouts, holds, strict=True) if held]
            if len(members):
                self.blocks = np.concatenate([self._found[:1], *members])
            self.ordered = self.ordered and self.blocks is not None
        elif holds.any():
            best = max(exact, _EQUAL * float(changes[holds].min()))
            which = np.flatnonzero(holds & (changes <= best))
            layout = min((layouts[i] for i in which), key=lambda layout: layout.shape[1])
            self.ordered = bool(changes[holds].min() > exact)
            self._take(layout)
        elif self._round == 2:
            self._round = _FINISHED

    def _take(self, layout: Indices) -> None:
        """Use a layout, or test it closely."""
        if self._round == 1 and not self.ordered:
            self.blocks, self._round = layout, _FINISHED
        else:
            self._found, self._round = layout, 2

    @property
    def _is_whole(self) -> bool:
        """Whether the layout that is tested closely has no leftovers."""
        return self._found is not None and self._found.size == self.dim

    def _layouts(self) -> list[Indices]:
        """Layouts that the present round tests."""
        if self._round == 0:
            layouts = whole_layouts(self.dim)
        elif self._round == 1:
            layouts = end_layouts(self.dim)
        elif self._is_whole and self._found is not None:
            layouts = [self._found]
        else:
            assert self._found is not None
            layouts = member_layouts(self.dim, self._found)
        return [layout for layout in layouts if self._axes.whole(layout)]

    def load_state_dict(
        self, state: Mapping[str, Any], sides: Sides | None = None, device: Any = None
    ) -> None:
        """Put back what `state_dict` gave; ValueError for what it cannot have given."""
        for name in ("blocks", "found"):
            within = maybe(array(name, "length", kind="i", low=0, high=self.dim - 1))
            check(state[name], within, {}, f"exchangeability[{name!r}]")
        if state["round"] == 2 and state["found"] is None:
            raise ValueError("exchangeability['found'] is None, and blocks are tested against it")
        super().load_state_dict(state)


def _matched(costs: Float64) -> tuple[Indices, Indices]:
    """Rows and columns of the assignment with the least sum of costs (n, n)."""
    from scipy.optimize import linear_sum_assignment  # most scenes have no blocks

    return linear_sum_assignment(costs)  # type: ignore[no-any-return]


def whole_layouts(dim: int) -> list[Indices]:
    """Layouts (n, L) without leftovers, shortest blocks first; n >= 2."""
    every = np.arange(dim)
    layouts = []
    for length in (n for n in range(1, dim // 2 + 1) if dim % n == 0):
        layouts.append(every.reshape(-1, length))
        if length > 1:
            layouts.append(every.reshape(length, -1).T)
    return layouts[:_MOST]


def end_layouts(dim: int) -> list[Indices]:
    """Pairs of blocks (2, L) at the beginning and at the end, for every short length L."""
    layouts = []
    for length in range(1, min(_LONGEST, dim // 2) + 1):
        layouts.append(np.arange(2 * length).reshape(2, length))
        layouts.append(np.arange(dim - 2 * length, dim).reshape(2, length))
    return layouts[:_MOST]


def member_layouts(dim: int, found: Indices) -> list[Indices]:
    """Pairs (2, L) of the first block of two and each other, in the order of their distance."""
    length = found.shape[1]
    if found[0, 0] == 0:
        starts = range(length, dim - length + 1, length)
    else:
        starts = range(dim - length, -1, -length)
    pairs = [np.stack([found[0], np.arange(start, start + length)]) for start in starts]
    return [pair for pair in pairs if pair[1, 0] != found[0, 0]]


def _rotated(x: Float64, layout: Indices) -> Float64:
    """Copy of x (d,) in which each block has the values of the next one."""
    y = x.copy()
    y[layout] = x[np.roll(layout, -1, axis=0)]
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
    for i, row in enumerate(plan):
        seen = repeats[1:] if i < _REPEATS else images[row.tobytes()]
        if seen:
            changes[i] = max(
                float((tokens[:, :channels].double() - first).square().mean()) for tokens in seen
            )
    return changes
