"""The next picture, with all that is remembered of those before it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fide_tasks
from fide_plugins.errors import ImageError, UnknownNameError
from fide_plugins.fide import FIDE
from fide_plugins.search.recall import Recalled
from fide_plugins.state import State
from fide_plugins.types import Float32, Float64

from .helpers import Render, StateOf

KINDS: dict[str, dict[str, Any]] = {
    "linear": {"popsize": 8, "patience": 3},
    "both, blocks": {"popsize": 8, "proposer": "both", "groups": [[0, 1, 2], [3, 4, 5]]},
    "paper": {"preset": "paper", "popsize": 6, "epochs": 1, "batch_size": 6},
    "losses only": {"popsize": 8, "proposer": "none"},
    "no memory": {"popsize": 8, "memory_mb": 0},
}
STEPS = {kind: 4 if kind == "paper" else 30 for kind in KINDS}  # the network takes its time


def go_on(opt: FIDE, render: Render, n: int) -> list[Float64]:
    """Ask and tell n times in pieces of three."""
    asked = []
    for _ in range(n):
        asked.append(opt.ask(3))
        opt.tell(asked[-1], render(asked[-1]))
    return asked


@pytest.mark.parametrize("kind", ["linear", "both, blocks", "paper"])
def test_a_picture_that_was_rendered_is_found_at_once(
    kind: str, target: Float32, render: Render
) -> None:
    opt = FIDE(6, target, seed=1, **KINDS[kind])
    asked = np.concatenate(go_on(opt, render, STEPS[kind]))
    x = asked[10]
    opt.retarget(render(x[None])[0])
    first = opt.ask(1)
    np.testing.assert_array_equal(first[0], x)
    opt.tell(first, render(first))
    assert opt.best is not None and opt.best.loss < 1e-12 and opt.status.code == "solved"


@pytest.mark.parametrize("kind", KINDS)
def test_the_books_begin_anew_and_the_curve_goes_on(
    kind: str, target: Float32, render: Render, answer: Float64
) -> None:
    opt = FIDE(6, target, seed=1, **KINDS[kind])
    go_on(opt, render, STEPS[kind])
    out = opt.ask(4)
    told, blocks = opt.evaluations, opt.state.moves.known.exchangeability.blocks
    picture = render(np.clip(answer + 0.03, 0, 1)[None])[0]
    opt.retarget(picture)
    assert opt.best is None and opt.solutions() == [] and opt.status.code == "waiting"
    assert opt.evaluations == told and len(opt.state.population.pending) == 0
    np.testing.assert_array_equal(opt.target, picture)
    assert opt.state.moves.known.exchangeability.blocks is blocks
    opt.tell(out, render(out))  # still out: they count as points that were never asked
    loss = np.square(render(out).astype(np.float64) - picture).mean(axis=(1, 2, 3))
    assert opt.best is not None and opt.best.loss == pytest.approx(loss.min())
    assert len(opt.state.population.told) == 0
    before = opt.best.loss
    go_on(opt, render, 6)
    assert opt.evaluations == told + 4 + 18
    assert opt.best.loss <= before


@pytest.mark.parametrize("kind", ["linear", "both, blocks", "paper", "losses only"])
def test_the_same_seed_gives_the_same_run_also_from_a_file(
    kind: str, target: Float32, render: Render, answer: Float64, tmp_path: Path
) -> None:
    pictures = render(np.clip(np.add(answer, [[0.02], [0.05]]), 0, 1))
    runs = [FIDE(6, target, seed=1, **KINDS[kind]) for _ in range(2)]
    for opt in runs:
        go_on(opt, render, STEPS[kind])
    for picture in pictures:
        runs[1].save(tmp_path / "before")
        runs[1] = FIDE.load(tmp_path / "before")
        for opt in runs:
            opt.retarget(picture)
        runs[1].save(tmp_path / "c")
        runs[1] = FIDE.load(tmp_path / "c")
        one, other = (go_on(opt, render, 5) for opt in runs)
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        (np.zeros((8, 16, 3)), ImageError, "must have the size of the first"),
        (np.full((16, 16, 3), np.nan), ImageError, "target"),
        ("nowhere.png", ImageError, "nowhere"),
    ],
)
def test_a_bad_picture_changes_nothing(
    wrong: object, error: type[Exception], message: str, target: Float32, render: Render,
    state_of: StateOf,
) -> None:  # fmt: skip
    opt = FIDE(6, target, seed=1, popsize=8)
    go_on(opt, render, 10)
    before = state_of(opt)
    with pytest.raises(error, match=message):
        opt.retarget(wrong)
    with pytest.raises(UnknownNameError):
        opt.retarget(target, loss="mean")
    assert state_of(opt) == before


def renders(opt: FIDE, render: Render, goal: float, most: int) -> int:
    """Renders until the loss is at most `goal`."""
    before = opt.evaluations
    while opt.evaluations - before < most:
        X = opt.ask(5)
        opt.tell(X, render(X))
        if opt.best is not None and opt.best.loss <= goal:
            break
    return opt.evaluations - before


def test_frames_of_a_drifting_scene_need_a_small_part_of_the_renders() -> None:
    """Against fresh searches, each frame at the loss that counts as solved (1e-3)."""
    task = fide_tasks.make("voronoi", size=32, cells=3, seed=3)
    assert task.x_star is not None
    rng = np.random.default_rng(0)
    drift = rng.uniform(-0.01, 0.01, task.dim)
    star = task.x_star + 6 * 0.01 * np.sign(0.5 - task.x_star)  # away from the walls
    frames = task.render(np.array([star + t * drift for t in range(3)]))
    opt = FIDE(task.dim, frames[0], seed=0)
    renders(opt, task.render, 1e-3, 1500)
    fresh, again = [], []
    for frame in frames[1:]:
        opt.retarget(frame)
        again.append(renders(opt, task.render, 1e-3, 300))
        fresh.append(renders(FIDE(task.dim, frame, seed=0), task.render, 1e-3, 300))
    assert sum(again) <= sum(fresh) / 3


def test_all_hypotheses_are_asked_first_however_few_samples_a_generation_has(
    target: Float32, render: Render, answer: Float64, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a generation of six, nearly all are proposals, which are made when they are asked for."""
    recalled: list[Recalled] = []

    def noted(state: State, *of: Any) -> Recalled:
        recalled.append(recall(state, *of))
        return recalled[-1]

    recall = State.recall
    monkeypatch.setattr(State, "recall", noted)
    most = 0
    for seed in range(6):
        opt = FIDE(6, target, popsize=6, seed=seed, proposal_fraction=0.8, fraction_rate=0.0)
        go_on(opt, render, 20)
        opt.retarget(render(np.clip(answer + 0.2, 0, 1)[None])[0])
        hypotheses = recalled[-1].hypotheses
        np.testing.assert_array_equal(opt.ask(len(hypotheses)), hypotheses)
        most = max(most, len(hypotheses))
    assert most > 1
