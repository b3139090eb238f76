"""A run that goes on has the target with which it began, where another render has other bits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import run as harness
from fide_lab.run.kept_target import same_target
from fide_plugins.errors import CheckpointError
from fide_plugins.recording.storage import RunDirectoryError

from .tint import Tint, same


class RendersItsTarget(Tint):
    """As on a GPU: no two renders have the same bits."""

    renders = 0

    def __init__(self, gray: float = 0.5) -> None:
        super().__init__()
        self.gray = gray

    @property
    def target(self) -> Any:  # type: ignore[override]
        type(self).renders += 1
        return np.full((6, 8, 3), self.gray + 1e-6 * self.renders, np.float32)


@pytest.fixture(autouse=True)
def from_the_first_render(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RendersItsTarget, "renders", 0)


def run(out: Path | None, *, resume: bool = False, budget: int = 45, gray: float = 0.5) -> Any:
    return harness.run(RendersItsTarget(gray), "cma", budget=budget, out=out, resume=resume)


def test_a_run_goes_on_with_the_bits_with_which_it_began(tmp_path: Path) -> None:
    run(tmp_path, budget=20)
    resumed = run(tmp_path, resume=True)
    assert RendersItsTarget.renders == 2
    RendersItsTarget.renders = 0
    assert same(resumed, run(None))


@pytest.mark.parametrize("gray", [0.5002, 0.9])
def test_more_than_rounding_is_another_target(gray: float, tmp_path: Path) -> None:
    """What renders it may have changed: a program, a version of a scene, the task itself."""
    run(tmp_path)
    with pytest.raises(RunDirectoryError, match="the target is another one; undo the edit"):
        run(tmp_path, resume=True, gray=gray)


def test_some_values_of_8_bits_may_be_a_step_off() -> None:
    """As those that lie between two steps, where another GPU rounds the other way."""
    one = (np.random.default_rng(0).integers(0, 255, (64, 64, 3)) / 255).astype(np.float32)
    other = one.copy()
    other[::32, 7, 0] += np.float32(1 / 255)
    assert same_target(one, other) and same_target(one, one)
    assert not same_target(one, one + np.float32(1 / 255))  # a change that all pixels show
    other[3, 3] += np.float32(3 / 255)
    assert not same_target(one, other) and not same_target(one, one[:32])


@pytest.mark.parametrize("cut", [True, False])
def test_a_damaged_file_is_refused(cut: bool, tmp_path: Path) -> None:
    run(tmp_path, budget=5)
    file = tmp_path / "target.ckpt"
    if cut:
        file.write_bytes(file.read_bytes()[:-1])
    else:
        file.write_bytes((tmp_path / "run.ckpt").read_bytes())
    message = "it was cut short" if cut else "it holds a 'run', not a 'target'"
    with pytest.raises(CheckpointError, match=f"target.ckpt: cannot load.*{message}"):
        run(tmp_path, resume=True)


SCENE = """
import os
import numpy as np
from fide_plugins import Float, Space

space = Space(x=Float(0, 1))
noise = np.random.default_rng(int.from_bytes(os.urandom(8), "little"))

def render(p):
    with open("renders", "a") as file:
        print(p, file=file)
    return np.clip(p["x"] + noise.normal(0, 1e-2, (8, 8)), 0, 1)
"""


def test_a_noisy_function_renders_its_target_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No second render can tell noise from a change, so its file and its parameters do."""
    monkeypatch.chdir(tmp_path)
    Path("scene.py").write_text(SCENE)
    harness.run("scene.py:render", "cma", budget=10, out="run")
    harness.run("scene.py:render", "cma", budget=20, out="run", resume=True)
    assert len(Path("renders").read_text().splitlines()) == 1 + 20
    with pytest.raises(RunDirectoryError, match="task_seed is 0 there and 3 here"):
        harness.run("scene.py:render", "cma", budget=20, out="run", resume=True, task_seed=3)
