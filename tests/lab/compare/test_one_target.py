"""All runs of a comparison have one target, also where no two renders have the same bits."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest

from fide_lab import compare
from fide_lab.compare import Plan
from fide_lab.report.sentences import METHOD
from fide_plugins.recording.storage import RunDirectoryError

from .conftest import small

NOISY = """
import os
import numpy as np
from fide_plugins import Float, Space

space = Space(x=Float(0, 1), y=Float(0, 1))
noise = np.random.default_rng(int.from_bytes(os.urandom(8), "little"))

def render(p):
    gray = np.outer(np.linspace(0, p["x"], 8), np.linspace(1, p["y"], 8))
    return np.clip(gray + noise.normal(0, 1e-3, (8, 8)), 0, 1)
"""


@pytest.fixture
def scene(tmp_path: Path) -> str:
    file = tmp_path / "scene.py"
    file.write_text(NOISY)
    return f"{file}:render"


def plan_of(scene: str, *optimizers: str, seeds: int = 1) -> Plan:
    return small(*optimizers, tasks=(scene,), seeds=seeds, task_options={}, losses=("mse",))


def targets(out: Path) -> set[str]:
    runs = [json.loads(path.read_text()) for path in out.rglob("run.json")]
    return {run["settings"]["target"] for run in runs}


@pytest.mark.thorough
@pytest.mark.parametrize("jobs", [1, 2])
def test_it_is_rendered_once_for_all_runs_and_all_calls(
    scene: str, jobs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fide_plugins.runtime.machine.cores", lambda: 2)
    out = tmp_path / "out"
    outcomes = compare.run(plan_of(scene, "cma", "random"), out, jobs=jobs)
    assert [outcome.kind for outcome in outcomes] == ["done"] * 2
    more = plan_of(scene, "cma", "random", "fide", seeds=2)
    kinds = [outcome.kind for outcome in compare.run(more, out, resume=True)]
    assert sorted(kinds) == ["done"] * 4 + ["kept"] * 2
    assert len(targets(out)) == 1
    assert {run.state for run in compare.read(out).runs} == {"finished"}
    assert [path.name for path in out.rglob("target.ckpt")] == []
    assert len(list((out / "targets").glob("*.ckpt"))) == 1


EXACT = NOISY.replace("1e-3", "0.0")
REMARK = "\n# nothing that shows"


def edit(scene: str, text: str) -> None:
    """Write another version of the renderer, as if the next process were to load it."""
    file = scene.removesuffix(":render")
    Path(file).write_text(text)
    for name, module in list(sys.modules.items()):
        if getattr(module, "__file__", None) == file:
            del sys.modules[name]


def run_again_after(scene: str, version: str, out: Path) -> list[str]:
    """Outcomes where the renderer was edited, and all runs of its first version were deleted."""
    compare.run(plan_of(scene, "cma"), out)
    shutil.rmtree(out / "cells")
    edit(scene, version)
    return [outcome.kind for outcome in compare.run(plan_of(scene, "cma"), out, resume=True)]


@pytest.mark.parametrize(
    ("version", "later"),
    [(EXACT, EXACT.replace("gray +", "1 - gray +")), (NOISY, NOISY + REMARK)],
)
def test_no_version_of_a_renderer_is_given_the_target_of_another(
    scene: str, version: str, later: str, tmp_path: Path
) -> None:
    """Of a noisy one nobody knows whether the edit has changed the images."""
    edit(scene, version)
    with pytest.raises(RunDirectoryError, match=r"render with other .*another one; undo"):
        run_again_after(scene, later, tmp_path / "out")


def test_a_call_that_is_killed_before_its_record_leaves_the_target_for_the_next(
    scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(path: Path, text: str) -> None:
        raise KeyboardInterrupt

    out = tmp_path / "out"
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("fide_lab.compare.directory.files.write_text", killed)
        compare.run(plan_of(scene, "cma"), out)
    (kept,) = (out / "targets").iterdir()
    before = kept.read_bytes()
    (out / "targets" / ".left.ckpt.0123456789ab.tmp").touch()
    assert [outcome.kind for outcome in compare.run(plan_of(scene, "cma"), out)] == ["done"]
    assert kept.read_bytes() == before


def test_the_loss_of_a_user_s_renderer_is_that_of_the_image_as_it_was_seen(
    scene: str, tmp_path: Path
) -> None:
    """It has no image without noise, and the method of a report says so."""
    compare.run(plan_of(scene, "random"), tmp_path / "out")
    (run,) = compare.read(tmp_path / "out").runs
    assert run.final == run.totals["best_loss"] == run.totals["reference_loss"] > 0
    assert any("renderer of your own cannot" in said for said in METHOD)


def test_a_user_s_folder_of_targets_is_not_taken_for_one_of_a_comparison(
    scene: str, tmp_path: Path
) -> None:
    own = tmp_path / "out" / "targets" / "voronoi.png"
    own.parent.mkdir(parents=True)
    own.write_bytes(b"mine")
    with pytest.raises(RunDirectoryError, match="files that belong to no comparison"):
        compare.run(plan_of(scene, "cma"), tmp_path / "out")
    assert own.read_bytes() == b"mine"
