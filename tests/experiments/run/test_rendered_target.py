"""A target that a task renders is rendered once in a run's life: the next one has other bits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins.errors import CheckpointError
from fide_plugins.experiments import run as harness
from fide_plugins.recording.directory import RunDirectoryError

from .tint import Tint, same


class RendersItsTarget(Tint):
    """As with noise, or on a GPU: no two renders have the same bits."""

    renders = 0

    def __init__(self, *, blue: float = 0.8) -> None:
        super().__init__()
        self.x_star = np.array([0.2, 0.5, blue])

    @property
    def target(self) -> Any:  # type: ignore[override]
        type(self).renders += 1
        return (self.x_star + 1e-6 * self.renders + np.zeros((6, 8, 3))).astype(np.float32)


@pytest.fixture(autouse=True)
def from_the_first_render(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RendersItsTarget, "renders", 0)


def run(out: Path | None, *, resume: bool = False, budget: int = 45, **task: float) -> Any:
    task_made = RendersItsTarget(**task)
    return harness.run(task_made, "cma", budget=budget, out=out, resume=resume)


def test_a_run_goes_on_with_the_target_that_it_began_with(tmp_path: Path) -> None:
    run(tmp_path, budget=20)
    resumed = run(tmp_path, resume=True)
    assert RendersItsTarget.renders == 1
    RendersItsTarget.renders = 0
    assert same(resumed, run(None))


def test_it_is_another_target_if_it_is_rendered_from_other_parameters(tmp_path: Path) -> None:
    run(tmp_path)
    with pytest.raises(RunDirectoryError, match=r"the target is another one.*keep it in a file"):
        run(tmp_path, resume=True, blue=0.7)


def test_it_is_kept_before_the_first_checkpoint(tmp_path: Path) -> None:
    begun = harness.prepare(RendersItsTarget(), "cma", budget=45, out=tmp_path)
    assert begun._directory is not None
    begun._directory.close()  # as if the process were killed
    assert not (tmp_path / "run.ckpt").exists()
    run(tmp_path, resume=True)
    assert RendersItsTarget.renders == 1


def test_one_of_other_parameters_that_is_left_over_is_replaced(tmp_path: Path) -> None:
    """By a run that was killed before it was written down."""
    run(tmp_path, budget=5, blue=0.7)
    left = (tmp_path / "target.ckpt").read_bytes()
    out = tmp_path / "new"
    out.mkdir()
    (out / "target.ckpt").write_bytes(left)
    run(out, budget=5)
    run(out, resume=True)


def test_a_run_that_keeps_no_checkpoint_keeps_no_target_for_it(tmp_path: Path) -> None:
    keep = harness.Keep(checkpoint=False)
    harness.run(RendersItsTarget(), "cma", budget=5, out=tmp_path, keep=keep)
    assert (tmp_path / "target.png").exists() and not list(tmp_path.glob("*.ckpt"))


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


def test_a_picture_is_read_again_and_compared(tmp_path: Path) -> None:
    """It has no parameters; its file may have changed."""

    class Given(Tint):
        def __init__(self, gray: float) -> None:
            super().__init__()
            self.target = np.full((6, 8, 3), gray, np.float32)

    harness.run(Given(0.5), "cma", budget=5, out=tmp_path)
    assert not (tmp_path / "target.ckpt").exists()
    harness.run(Given(0.5), "cma", budget=5, out=tmp_path, resume=True)
    with pytest.raises(RunDirectoryError, match="the target is another one"):
        harness.run(Given(0.6), "cma", budget=5, out=tmp_path, resume=True)
