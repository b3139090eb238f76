"""What a learned model leaves open is drawn again around the best so far."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fide_plugins import Choice, Float, Space
from fide_plugins.search.exchangeability import Exchangeability
from fide_plugins.search.hypotheses import Hypotheses, Resample
from fide_plugins.search.moves import Known
from fide_plugins.search.policy import MovePolicy, Stage
from fide_plugins.search.scene import Axes, Removal, Sensitivity
from fide_plugins.types import Float64, Posterior

from ..conftest import sample

HERE = np.array([0.3, 0.7, 0.2, 0.5])
KNOWN, OPEN = [0, 1], [2, 3]


def scene(
    x: Float64 = HERE, axes: Axes | None = None, groups: list[list[int]] | None = None
) -> Known:
    """A search ended at x."""
    d = len(x)
    axes = axes or Axes(d)
    known = Known(
        x0=np.full(d, 0.5),
        sigma0=np.full(d, 1 / 6),
        target=torch.zeros(16, 3),
        channels=3,
        exchangeability=Exchangeability(d, 3, groups or [], axes),
        removal=Removal(),
        sensitivity=Sensitivity(d, 3),
        axes=axes,
    )
    known.incumbent = sample(np.zeros(16), x)
    known.optima.note(known.incumbent, known.exchangeability.distance)
    return known


def hypotheses(n: int = 512, seed: int = 0) -> Float64:
    """They agree in two parameters, have two values in the third, and any in the last."""
    rng = np.random.default_rng(seed)
    x = np.tile(HERE, (n, 1)) + 0.01 * rng.standard_normal((n, 4))
    x[:, 2] = np.where(rng.random(n) < 0.5, 0.2, 0.74)
    x[:, 3] = rng.random(n)
    return np.clip(x, 0, 1)


@pytest.mark.parametrize("n", [1, 2, 7, 20])
def test_candidates_keep_what_is_known_and_have_values_of_hypotheses(n: int) -> None:
    known, there = scene(), hypotheses()
    x = Resample(Hypotheses(Posterior(there), 4)).draw(known, n, np.random.default_rng(1))
    assert x.shape == (n, 4)
    np.testing.assert_array_equal(x[:, KNOWN], np.tile(HERE[KNOWN], (n, 1)))
    for axis in OPEN:
        moved = x[:, axis] != HERE[axis]
        assert np.isin(x[moved, axis], there[:, axis]).all()
    assert ((x[::2] != HERE).sum(axis=1) == 1).all()  # every second one in a single parameter
    together = x[1::2]
    assert all((there[:, OPEN] == row[OPEN]).all(axis=1).any() for row in together)


def test_single_changes_are_spread_over_what_hypotheses_have() -> None:
    known = scene()
    x = Resample(Hypotheses(Posterior(hypotheses()), 4)).draw(known, 40, np.random.default_rng(2))[
        ::2
    ]
    other, any_ = (x[x[:, axis] != HERE[axis], axis] for axis in OPEN)
    np.testing.assert_array_equal(other, np.full(10, 0.74))  # the value that is not here
    assert np.diff(np.sort(any_)).max() < 0.35  # two strata of ten, and the gap around what is here


def test_there_is_nothing_to_draw_where_hypotheses_agree_or_there_are_none() -> None:
    there = hypotheses()
    there[:, OPEN] = HERE[OPEN]
    assert not Resample(Hypotheses(Posterior(there), 4)).possible(scene())
    assert not Resample(Hypotheses(None, 4)).possible(scene())
    assert Resample(Hypotheses(Posterior(hypotheses()), 4)).possible(scene())
    assert not Resample(Hypotheses(Posterior(hypotheses()), 4)).possible(
        scene(groups=[[0, 1], [2, 3]])
    )


def test_a_circle_has_no_ends_and_the_axes_of_a_choice_belong_together() -> None:
    space = Space(angle=Float(0, 360, periodic=True), kind=Choice("a", "b", "c"))
    axes = Axes(space.dim, space.layout)
    rng = np.random.default_rng(0)
    there = np.column_stack(
        [np.mod(0.01 * rng.standard_normal(400), 1), np.eye(3)[rng.integers(3, size=400)]]
    )
    known = scene(np.array([0.999, 1.0, 0.0, 0.0]), axes)
    x = Resample(Hypotheses(Posterior(there), space.dim)).draw(known, 30, rng)
    np.testing.assert_array_equal(x[:, 0], np.full(30, 0.999))
    assert (np.isin(x[:, 1:], [0, 1])).all() and (x[:, 1:].sum(axis=1) == 1).all()


def test_a_search_begins_wide_in_what_was_drawn() -> None:
    known = scene()
    move = Resample(Hypotheses(Posterior(hypotheses()), 4))
    start = move.begin_at(known, np.array([0.3, 0.7, 0.74, 0.5]))
    assert start.std[2] > 3 * start.std[[0, 1, 3]].max()


def policy() -> MovePolicy:
    return MovePolicy(
        np.full(4, 0.5), np.full(4, 1 / 6), 9, torch.zeros(16, 3), 3, 0, [],
        posterior=Posterior(hypotheses()),
    )  # fmt: skip


def test_it_follows_a_search_from_a_hypothesis_and_itself_while_it_helps() -> None:
    moves, rng = policy(), np.random.default_rng(0)
    several = [sample(np.full(16, 0.1), x, 1.0 + 0.001 * i) for i, x in enumerate(moves.draw(rng))]
    assert moves.learn(several, several[0].x) is Stage.SEARCH
    starts = 1 + int(moves.hypotheses.waiting)
    assert starts == 2
    seen, loss = [], 1.0
    for helps in (True, True, False):
        loss *= 0.5 if helps else 1.0
        found = sample(np.full(16, 0.1), np.append(HERE[:3], loss), loss if helps else 2 * loss)
        moves.after_search(found, 100, guided=True)
        seen.append((moves.stage, moves.move))
        if moves.stage is Stage.RESTART:
            draws = [sample(np.full(16, 0.1), x, 3.0) for x in moves.draw(rng)]
            moves.learn(draws, draws[0].x)
    assert seen == [
        (Stage.RESTART, "resample"),
        (Stage.RESTART, "resample"),
        (Stage.SEARCH, "learned"),
    ]


def test_a_search_by_losses_alone_goes_on_with_the_next_hypothesis() -> None:
    moves, rng = policy(), np.random.default_rng(0)
    x = moves.draw(rng)
    moves.learn([sample(np.full(16, 0.1), row, 1.0 + i) for i, row in enumerate(x)], x[0])
    assert moves.after_search(None, 100, guided=False) is Stage.SEARCH
    assert moves.move == "learned" and not moves.guided


def test_what_followed_a_hypothesis_can_be_told_to_others() -> None:
    """Who is told whether images guided, and has the same hypotheses, goes on as the first one."""
    for guided in (True, False):
        one, other = policy(), policy()
        for moves in (one, other):
            x = moves.draw(np.random.default_rng(0))
            moves.learn([sample(np.full(16, 0.1), row, 1.0 + i) for i, row in enumerate(x)], x[0])
        found = sample(np.full(16, 0.1), HERE, 0.5)
        one.after_search(found, 100, guided=guided)
        other.after_search(found, 100, guided=one.guided)
        assert (one.stage, one.move, one.guided) == (other.stage, other.move, guided)


def test_after_a_search_without_images_a_worse_one_is_followed_by_tests_of_the_best() -> None:
    """The scene was not tested before: hypotheses came first, and images did not guide them."""
    moves, rng = policy(), np.random.default_rng(0)
    x = moves.draw(rng)
    moves.learn([sample(np.full(16, 0.1), row, 1.0 + i) for i, row in enumerate(x)], x[0])
    best = sample(np.full(16, 0.1), HERE, 0.5)
    while moves.move == "learned":
        moves.after_search(best, 100, guided=False)
    assert moves.known.incumbent is None and not moves.known.exchangeability.finished
    worse = sample(np.full(16, 0.1), 1 - HERE, 0.9)
    assert moves.after_search(worse, 100, guided=True) is Stage.EXCHANGE
    np.testing.assert_array_equal(moves.draw(rng)[0], HERE)
    policy().load_state_dict(moves.state_dict())


def test_what_is_in_the_right_place_is_refined_before_anything_else_is_tried() -> None:
    moves, rng = policy(), np.random.default_rng(0)
    several = [sample(np.full(16, 0.1), x, 1.0 + i) for i, x in enumerate(moves.draw(rng))]
    moves.learn(several, several[0].x)
    below = moves.hypotheses.strict_above
    assert below is not None and below < 3.0  # a tenth of the median, about 24
    seen, loss = [], below
    for gain in (1.0, 0.5, 0.0):  # in the right place; better by a half; no better
        loss *= 1 - 0.5 * (gain == 0.5)
        moves.after_search(sample(np.full(16, 0.1), HERE, loss), 100, guided=True)
        seen.append((moves.stage, moves.move))
        assert not moves.start.to_the_end, "other hypotheses wait"
    refined, next_one = (Stage.SEARCH, "refine"), (Stage.SEARCH, "learned")
    assert seen == [refined, refined, next_one]
