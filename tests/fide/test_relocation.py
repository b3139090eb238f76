"""A search that has stalled: probes, scouts, and a search from the best scout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest

import fide_tasks
from fide_plugins.fide import FIDE
from fide_plugins.images import Float32
from fide_plugins.points import Float64
from fide_plugins.search.relocate import Stage

Render: TypeAlias = Callable[[Float64], Float32]
StateOf: TypeAlias = Callable[[FIDE], bytes]
SHORT: dict[str, Any] = {"seed": 0, "popsize": 8, "patience": 3}


def until(stage: Stage, target: Float32, render: Render, **settings: Any) -> FIDE:
    """An optimizer whose next candidates are of that stage."""
    opt = FIDE(6, target, **(SHORT | settings))
    for _ in range(300):
        if opt._stage is stage:
            return opt
        X = opt.ask()
        opt.tell(X, render(X))
    raise AssertionError(f"no {stage} in 300 generations")


def stage_of(opt: FIDE) -> Stage:
    return opt._stage


def test_a_round_of_probes_then_scouts_then_a_search(target: Float32, render: Render) -> None:
    opt = until(Stage.PROBE, target, render)
    assert opt.best is not None
    stalled = opt._relocation.incumbent
    assert stalled is not None
    np.testing.assert_array_equal(stalled.x, opt.best.x)
    probes = opt.ask()
    np.testing.assert_array_equal(probes != stalled.x, np.eye(6, dtype=bool))
    opt.tell(probes, render(probes))
    scouts = opt.ask()
    assert len(scouts) == 20
    assert ((scouts != stalled.x).any(axis=1)).all()
    losses = np.linspace(2.0, 1.0, 20)
    opt.tell(scouts, render(scouts), losses)
    assert stage_of(opt) is Stage.SEARCH and opt._searches == 2
    np.testing.assert_array_equal(opt._search.mean, scouts[-1])
    assert len(opt.ask()) == 8


def test_many_workers_may_ask_ahead(target: Float32, render: Render) -> None:
    """More probes than there are parameters, told in pieces and too late, stop nothing."""
    opt = until(Stage.PROBE, target, render)
    first, second = opt.ask(), opt.ask(9)
    opt.tell(second[::2], render(second[::2]))
    opt.tell(first, render(first))
    assert stage_of(opt) is Stage.SCOUT
    scouts = opt.ask()
    opt.tell(second[1::2], render(second[1::2]))  # guests by now
    assert stage_of(opt) is Stage.SCOUT
    opt.tell(scouts, render(scouts))
    assert stage_of(opt) is Stage.SEARCH


@pytest.mark.parametrize("stage", [Stage.PROBE, Stage.SCOUT])
def test_probes_and_scouts_may_fail(stage: Stage, target: Float32, render: Render) -> None:
    for value in (np.nan, np.inf):
        opt = until(stage, target, render)
        X = opt.ask()
        opt.tell(X, render(X), np.full(len(X), value))
        for _ in range(60):
            X = opt.ask()
            assert np.isfinite(X).all() and X.min() >= 0 and X.max() <= 1
            opt.tell(X, None, np.square(X - 0.3).sum(axis=1))
        assert opt._searches > 1


def test_a_scout_that_is_the_best_is_recommended(target: Float32, render: Render) -> None:
    opt = until(Stage.SCOUT, target, render)
    scouts = opt.ask()
    losses = np.ones(20)
    losses[7] = -1.0
    opt.tell(scouts, render(scouts), losses)
    assert opt.best is not None
    np.testing.assert_array_equal(opt.best.x, scouts[7])
    np.testing.assert_array_equal(opt.recommend(), scouts[7])


@pytest.mark.parametrize("stage", [Stage.PROBE, Stage.SCOUT])
def test_saved_in_the_middle(
    stage: Stage, target: Float32, render: Render, state_of: StateOf, tmp_path: Path
) -> None:
    original = until(stage, target, render)
    X = original.ask(4)
    original.tell(X[:2], render(X[:2]))
    original.save(tmp_path / "c")
    copy = FIDE.load(tmp_path / "c")
    assert state_of(copy) == state_of(original)
    for opt in (original, copy):
        opt.tell(X[2:], render(X[2:]))
        for _ in range(40):
            X_next = opt.ask(5)
            opt.tell(X_next, render(X_next))
    assert state_of(copy) == state_of(original)


@pytest.mark.parametrize("restarts", ["anew", "none"])
def test_can_be_switched_off(restarts: str, target: Float32, render: Render) -> None:
    opt = FIDE(6, target, restarts=restarts, **SHORT)
    for _ in range(60):
        X = opt.ask()
        assert len(X) == 8
        opt.tell(X, render(X))
        assert stage_of(opt) is Stage.SEARCH
    assert (opt._searches > 1) == (restarts == "anew")


def test_cells_are_found_to_be_parts() -> None:
    """Of Voronoi cells, each the five parameters of one, most are told apart from images alone."""
    task = fide_tasks.make("voronoi", 64, 0)
    opt = FIDE(task.dim, task.target, seed=0, patience=5)
    for _ in range(1000):
        X = opt.ask()
        opt.tell(X, task.render(X))
        if opt._relocation._rounds == 4:
            break
    assert opt._relocation._rounds == 4
    cells = np.arange(task.dim) // 5
    parts = [part for part in opt._relocation.parts if len(part) > 1]
    pure = sum(int(np.bincount(cells[part]).max()) for part in parts)
    assert pure >= 0.85 * sum(map(len, parts)), "parts of one cell each"
    assert sum(map(len, parts)) >= 0.7 * task.dim, "few parameters are left alone"
