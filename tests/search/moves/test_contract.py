"""What every move promises."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from fide_plugins.population import TrainingSample
from fide_plugins.search.hypotheses import Hypotheses, Resample
from fide_plugins.search.mixed import Axes, Values
from fide_plugins.search.moves import (
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
)
from fide_plugins.search.scene import Exchangeability, Sensitivity
from fide_plugins.space import Choice, Float, Int, Space
from fide_plugins.types import Posterior

SPACE = Space(
    turn=Float(0, 1, periodic=True), floor=Choice("a", "b", "c"), n=Int(1, 5), x=Float(0, 1)
)
HYPOTHESES = np.random.default_rng(1).random((64, SPACE.dim))


def resample() -> Resample:
    return Resample(Hypotheses(Posterior(HYPOTHESES), SPACE.dim, place=SPACE.layout.snap))


MOVES: dict[str, tuple[Callable[[], Move], bool]] = {
    "split": (Split, True),
    "half turn": (HalfTurn, False),
    "relocate group": (RelocateGroup, True),
    "relocate segment": (RelocateSegment, False),
    "rearrange": (Rearrange, False),
    "change value": (ChangeValue, False),
    "coarsen": (Coarsen, False),
    "refine": (Refine, False),
    "random restart": (RandomRestart, False),
    "resample": (resample, False),
}
"""How each is made, and whether it is tried where blocks are exchangeable."""
FOR_ANY_BLOCKS = ("relocate group", "change value", "coarsen", "refine", "random restart")


def scene(*, blocks: bool) -> Known:
    """A mixed space, or four exchangeable blocks, after a search that was left in vain."""
    dim = 8 if blocks else SPACE.dim
    layout = None if blocks else SPACE.layout
    axes, target = Axes(dim, layout), torch.ones((4, 3))
    groups = np.arange(8).reshape(4, 2).tolist() if blocks else []
    known = Known(
        x0=np.full(dim, 0.5),
        sigma0=np.full(dim, 1 / 6),
        target=target,
        channels=3,
        exchangeability=Exchangeability(axes, 3, groups),
        sensitivity=Sensitivity(axes, 3),
        axes=axes,
        values=Values(axes),
        blurs=True,
    )
    known.exchangeability.chain = None if blocks else np.array([[0], [4], [5]])
    x = np.linspace(0.1, 0.9, dim) if blocks else SPACE.layout.snap(np.full((1, dim), 0.3))[0]
    known.incumbent = TrainingSample(0, x, 0.5 * target, 1.0, 0)
    known.optima.note(known.incumbent, known.exchangeability.distance)
    known.optima.fail(known.incumbent)
    return known


@pytest.fixture(params=MOVES)
def case(request: pytest.FixtureRequest) -> tuple[Move, Known]:
    make, blocks = MOVES[request.param]
    move, known = make(), scene(blocks=blocks)
    assert move.name == request.param
    if blocks:
        known.removal.learn(known.current, [], np.arange(8).reshape(4, 2), 3)
    return move, known


def test_candidates_lie_in_the_cube_and_are_those_of_the_seed(case: tuple[Move, Known]) -> None:
    move, known = case
    assert (move.possible(known) and move.needs(known) is None) or move.name == "relocate segment"
    x, again = (move.draw(known, 30, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(x, again)
    assert 1 <= len(x) <= 30 and x.shape[1] == known.axes.dim and x.min() >= 0 and x.max() <= 1
    assert not move.has_more or (x != move.draw(known, 30, np.random.default_rng(4))).any()


def test_axes_of_a_choice_are_moved_together(case: tuple[Move, Known]) -> None:
    move, known = case
    if not move.from_incumbent or move.name in ("refine", "half turn", "coarsen"):
        return
    for x in move.draw(known, 30, np.random.default_rng(3)):
        moved = np.flatnonzero(x != known.current.x)
        whole = known.axes.together(moved)
        one = [axes for axes in known.axes.axes_of if np.isin(axes, whole).any()]
        assert sum(len(axes) for axes in one) == len(whole)


def test_a_search_begins_at_a_candidate_or_at_the_incumbent(case: tuple[Move, Known]) -> None:
    move, known = case
    x = move.draw(known, 5, np.random.default_rng(3))[0]
    start = move.begin_at(known, x)
    expected = known.current.x if move.name == "refine" else x
    np.testing.assert_array_equal(start.mean, expected)
    assert start.std.shape == (known.axes.dim,) and (start.std > 0).all()
    assert move.possible(known) == (move.name != "refine")


@pytest.mark.parametrize("name", MOVES)
def test_blocks_decide_which_moves_are_possible(name: str) -> None:
    make, blocks = MOVES[name]
    expected = name in FOR_ANY_BLOCKS and name != "change value"
    assert make().possible(scene(blocks=not blocks)) == expected
