"""A search that has stalled: tests, restart candidates, and a search from the best of them."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from fide_plugins.fide import FIDE
from fide_plugins.search.moves import Stage
from fide_plugins.types import Float32

from .helpers import Render, StateOf

SHORT: dict[str, Any] = {"seed": 0, "popsize": 8, "patience": 2, "improvement": 0.5}
STAGES = [Stage.EXCHANGE, Stage.SENSITIVITY, Stage.REMOVAL, Stage.RESTART]


def settings(stage: Stage) -> dict[str, Any]:
    """Removal costs are asked for only where groups are exchangeable."""
    return {"groups": [[0, 1, 2], [3, 4, 5]]} if stage is Stage.REMOVAL else {}


def until(stage: Stage, target: Float32, render: Render, **options: Any) -> FIDE:
    """An optimizer whose next candidates are of that stage.

    The way there is gone once for each render and options; others start from a checkpoint of it.
    """
    key = (stage, render, target.tobytes(), repr(sorted(options.items())))
    if key not in _REACHED:
        _REACHED[key] = saved(reach(stage, target, render, **options))
    with TemporaryDirectory() as folder:
        path = Path(folder, "c")
        path.write_bytes(_REACHED[key])
        return FIDE.load(path)


_REACHED: dict[Any, bytes] = {}


def saved(opt: FIDE) -> bytes:
    with TemporaryDirectory() as folder:
        opt.save(Path(folder, "c"))
        return Path(folder, "c").read_bytes()


def reach(stage: Stage, target: Float32, render: Render, **options: Any) -> FIDE:
    opt = FIDE(6, target, **(SHORT | settings(stage) | options))
    for _ in range(600):
        if opt.state.moves.stage is stage:
            return opt
        X = opt.ask()
        opt.tell(X, render(X))
    raise AssertionError(f"no {stage} in 600 generations")


def test_a_stalled_search_is_left_by_a_move(target: Float32, render: Render) -> None:
    opt = until(Stage.RESTART, target, render)
    incumbent, searches = opt.state.moves.known.current, opt.state.searches
    assert opt.state.search_best is None, "tests of the scene are no place where a search ends"
    X = opt.ask()
    assert len(X) == 20 and (incumbent.x != X).any(axis=1).all()
    opt.tell(X, render(X))
    assert opt.state.moves.stage is Stage.SEARCH and opt.state.searches == searches + 1
    assert any((opt.state.search.mean == x).all() for x in [*X, incumbent.x])
    assert len(opt.ask()) == 8


@pytest.mark.parametrize("stage", STAGES)
def test_many_workers_may_ask_ahead(stage: Stage, target: Float32, render: Render) -> None:
    """More candidates than a stage has, told in pieces and too late, stop nothing."""
    opt = until(stage, target, render)
    first, second = opt.ask(), opt.ask(9)
    opt.tell(second[::2], render(second[::2]))
    opt.tell(first, render(first))
    following = {Stage.EXCHANGE: Stage.EXCHANGE, Stage.RESTART: Stage.SEARCH}  # of several tests
    assert opt.state.moves.stage is following.get(stage, Stage.RESTART)
    opt.tell(second[1::2], render(second[1::2]))  # never asked, by now
    for _ in range(15):
        X = opt.ask()
        opt.tell(X, render(X))


def test_a_restart_candidate_that_is_the_best_is_recommended(
    target: Float32, render: Render
) -> None:
    opt = until(Stage.RESTART, target, render)
    X = opt.ask()
    losses = np.ones(len(X))
    losses[7] = -1.0
    opt.tell(X, render(X), losses)
    assert opt.best is not None
    np.testing.assert_array_equal(opt.best.x, X[7])
    np.testing.assert_array_equal(opt.recommend(), X[7])


@pytest.mark.parametrize("stage", STAGES)
def test_saved_in_the_middle(
    stage: Stage, target: Float32, render: Render, state_of: StateOf, tmp_path: Path
) -> None:
    original = until(stage, target, render)
    X = original.ask(2)
    original.tell(X[:1], render(X[:1]))
    original.save(tmp_path / "c")
    copy = FIDE.load(tmp_path / "c")
    assert state_of(copy) == state_of(original)
    for opt in (original, copy):
        opt.tell(X[1:], render(X[1:]))
        for _ in range(20):
            X_next = opt.ask(5)
            opt.tell(X_next, render(X_next))
    assert state_of(copy) == state_of(original)


@pytest.mark.parametrize("restarts", ["anew", "none"])
def test_can_be_switched_off(restarts: str, target: Float32, render: Render) -> None:
    opt = FIDE(6, target, restarts=restarts, **SHORT)
    means = set()
    for _ in range(80):
        X = opt.ask()
        assert len(X) % 8 == 0
        opt.tell(X, render(X))
        assert opt.state.moves.stage is Stage.SEARCH
        means.add(tuple(opt.state.moves.start.mean))
    assert (opt.state.searches > 1) == (restarts == "anew")
    assert len(means) == (opt.state.searches if restarts == "anew" else 1), "each somewhere else"
