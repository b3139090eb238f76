"""The plan of a fit with a limit of time: what is measured first, and what follows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fide_plugins import FIDE, Fidelity, fit, load_run
from fide_plugins.fitting.fidelity import schedule_for
from fide_plugins.fitting.rendering import Outcome, Rendered
from fide_plugins.fitting.schedule import planned
from fide_plugins.fitting.workers import InThisProcess
from fide_plugins.types import Float64

from .test_fidelity import ANSWER, SPACE, Asked, draw, renderer

FIDELITY = Fidelity(size=(16, 64), samples=(4, 4))


@pytest.fixture(scope="module")
def target() -> Float64:
    return draw(ANSWER, (64, 64), 64, 10**6)


@pytest.mark.parametrize(("start", "kept"), [(0.0, [16, 32, 64]), (0.02, [32, 64]), (0.5, [64])])
def test_sizes_that_save_no_time_are_left_out(
    target: Float64, start: float, kept: list[int]
) -> None:
    def rendered(asked: Any) -> Outcome:
        return Rendered(None, start + 0.05 * (asked[1]["size"][0] / 64) ** 2)

    optimizer = FIDE(SPACE, target, seed=0)
    schedule = schedule_for(renderer([]), FIDELITY, optimizer)
    assert schedule is not None
    lines = planned(schedule, optimizer, InThisProcess(rendered), None, 60.0)
    assert [size[0] for size in schedule.sizes] == kept
    small = None if kept == [64] else (kept[0], kept[0])
    assert optimizer.evaluator.size == small
    assert len(lines) == 3 and ("save no time" in lines[0]) == (len(kept) < 3)
    assert schedule.cost == pytest.approx(1 + 1 / 4 + 2 / 16)


def test_the_plan_is_printed_kept_and_made_once(
    target: Float64, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: Asked = []
    options: dict[str, Any] = {"time": "10m", "fidelity": FIDELITY, "out": tmp_path, "workers": 0}
    options |= {"seed": 0, "until": "budget"}
    result = fit(renderer(asked), target, SPACE, 8, progress=True, **options)
    assert [size[0] for _, size, *_ in asked[:4]] == [16, 16, 32, 64]
    assert len(result.plan) == 3 and asked[-1][1] == (64, 64)
    printed = capsys.readouterr().err
    assert all(f"plan: {line}\n" in printed for line in result.plan)
    totals = json.loads((tmp_path / "run.json").read_text())["totals"]
    assert totals["plan"] == list(result.plan) and totals["cost"] == result.cost
    assert load_run(tmp_path).plan == result.plan
    again = fit(renderer(asked), target, SPACE, 12, resume=True, **options)
    assert again.plan == result.plan and again.evaluations == 12 and asked[-1][1] == (64, 64)
    assert "plan:" not in capsys.readouterr().err


def test_a_fit_that_is_saved_later_has_its_plan(target: Float64, tmp_path: Path) -> None:
    options: dict[str, Any] = {"time": "10m", "fidelity": FIDELITY, "workers": 0, "seed": 0}
    result = fit(renderer([]), target, SPACE, 8, until="budget", **options)
    result.save(tmp_path)
    assert len(result.plan) == 3 and load_run(tmp_path).plan == result.plan
