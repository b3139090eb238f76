"""What comes after what, on a scene that is known; and that it goes on from a saved state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fide_plugins.population import TrainingSample
from fide_plugins.search.moves import Stage
from fide_plugins.search.policy import MovePolicy
from fide_plugins.search.scene import Optima
from fide_plugins.types import Float64

from ..conftest import brightest, sample

BLOCKS = np.arange(8).reshape(4, 2)
STAR = np.array([0.1, 0.8, 0.4, 0.8, 0.6, 0.8, 0.9, 0.8])
MIXING = np.random.default_rng(5).standard_normal((16, 8))


def exchangeable(x: Float64) -> TrainingSample:
    image = brightest(x, BLOCKS)
    return sample(image, x, float(np.square(image - brightest(STAR, BLOCKS)).mean()))


def mixed(x: Float64) -> TrainingSample:
    image = np.tanh(MIXING @ x)
    return sample(image, x, float(np.square(image - np.tanh(MIXING @ STAR)).mean()))


def policy(render: Any = exchangeable, seed: int = 0, **options: Any) -> MovePolicy:
    x0, sigma0 = np.full(8, 0.5), np.full(8, 1 / 6)
    return MovePolicy(x0, sigma0, 9, render(STAR).tokens, 3, seed, **options)


def round_of(moves: MovePolicy, render: Any, rng: np.random.Generator) -> Stage:
    """Ask, render and tell one generation that is no search's."""
    several = [render(x) for x in moves.draw(rng)]
    moves.learn(several, min(several, key=lambda one: one.loss).x)
    return moves.stage


def steps(moves: MovePolicy, render: Any, seed: int, n: int) -> list[tuple[Stage, str | None]]:
    """Stages and moves of n decisions; each search ends a little beside its start."""
    rng, seen = np.random.default_rng(seed), []
    for _ in range(n):
        if moves.stage is Stage.SEARCH:
            x = np.clip(moves.start.mean + 0.02 * rng.standard_normal(8), 0, 1)
            moves.after_search(render(x), 150, guided=True)
        else:
            round_of(moves, render, rng)
        seen.append((moves.stage, moves.move))
    return seen


def test_exchangeability_is_tested_once_then_moves_follow() -> None:
    moves = policy()
    seen = steps(moves, exchangeable, 0, 200)
    stages = [stage for stage, _ in seen]
    assert stages[0] is Stage.EXCHANGE and stages.count(Stage.EXCHANGE) == 1
    assert Stage.SENSITIVITY not in stages and Stage.REMOVAL in stages
    names = {name for _, name in seen[1:]}
    assert {"split", "relocate group", "refine"} <= names
    assert "relocate segment" not in names


def test_without_blocks_other_moves_follow() -> None:
    seen = steps(policy(mixed), mixed, 0, 150)
    stages = [stage for stage, _ in seen]
    assert Stage.REMOVAL not in stages and stages.count(Stage.SENSITIVITY) == 1
    names = {name for _, name in seen[4:]}
    assert names == {
        "half turn", "relocate group", "relocate segment", "refine", "random restart",
    }  # fmt: skip


@pytest.mark.parametrize("render", [exchangeable, mixed])
@pytest.mark.parametrize("after", range(0, 40, 5))
def test_state_goes_on_in_the_middle_of_every_move(render: Any, after: int) -> None:
    original = policy(render)
    steps(original, render, 0, after)
    copy = policy(render, seed=99)
    copy.load_state_dict(original.state_dict())
    assert steps(copy, render, 1, 15) == steps(original, render, 1, 15)
    assert repr(copy.state_dict()) == repr(original.state_dict())


def test_optima_are_tried_by_rank_and_failures() -> None:
    optima = Optima()

    def distance(a: Float64, b: Float64, enough: float = np.inf) -> float:
        return float(np.abs(a - b).max())

    assert optima.next(2) is None
    best, second = (
        TrainingSample(i, np.full(2, i / 2), mixed(STAR).tokens, i + 1.0, i) for i in (0, 1)
    )
    assert optima.note(best, distance) and not optima.note(second, distance)
    order = []
    for _ in range(12):
        following = optima.next(2)
        order.append(following)
        if following is not None:
            optima.fail(following)
    assert order == [best, best, None, *[best, second, None] * 3]
    near = TrainingSample(2, best.x + 0.01, best.tokens, 1.5, 2)
    assert not optima.note(near, distance) and len(optima.all) == 2
    assert optima.all[0].searches == 2
    nearer = TrainingSample(3, best.x + 0.01, best.tokens, 0.5, 3)
    assert optima.note(nearer, distance) and len(optima.all) == 2
    assert optima.all[0].searches == 3 and optima.all[0].failures == 0


def test_only_searches_that_began_elsewhere_are_evidence_of_an_optimum() -> None:
    """Others keep most parameters, right or wrong, so that they come back to them."""
    moves, counted, kept = policy(mixed), 1, 0
    rng = np.random.default_rng(0)
    for _ in range(150):
        if moves.stage is not Stage.SEARCH:
            round_of(moves, mixed, rng)
            continue
        x = np.clip(moves.start.mean + 0.02 * rng.standard_normal(8), 0, 1)
        if moves.move is not None:
            changed = (moves.start.mean != moves.known.current.x).sum()
            back = moves.move != "random restart" and rng.random() < 0.5
            x = moves.known.current.x if back else x  # or it ends where it began
            apart = np.abs(x - moves.start.mean)[moves.start.mean != moves.known.current.x]
            returned = changed > 4 and bool((apart >= 0.05).all())
            counted += moves.move == "random restart" or returned
            kept += back and not returned
            assert not (returned and moves.move == "refine")
        moves.after_search(mixed(x), 150, guided=True)
        assert (
            sum(one.searches for one in moves.known.optima.all) + moves.known.optima.forgotten
            == counted
        )
    assert counted > 5 and kept > 10
