"""Problems whose target the renderer did not draw, and the runs that they judge."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import optimizers, run as harness, suite as suites
from fide_lab.compare.results import Curve
from fide_lab.run import prepare
from fide_lab.run.foreign import Foreign
from fide_lab.run.task import TaskInfo
from fide_lab.suite import foreign
from fide_plugins.cli import main
from fide_plugins.comparison.coverage import is_pair
from fide_plugins.fide import FIDE
from fide_plugins.recording.record import Record

SUITE = suites.read("image-fitting-foreign-v1")
NEEDS = {"robot": "mujoco", "silhouette": "mujoco"}
MITSUBA = [name for name in SUITE.scenes if name.startswith(("courtyard", "ball_mitsuba"))]
ERRORS_AT_TRUTH = {"board": 0.5, "board_near": 0.5}  # pixels: another's calibration


def test_the_definition() -> None:
    assert SUITE.scenes.keys() == foreign.SCENES.keys()
    assert len(SUITE.problems(SUITE.scenes, 99)) == 134
    assert {scene.metric for scene in SUITE.scenes.values()} == {"error"}
    with pytest.raises(ValueError, match=r"'wall-2'.*a number from 0 to 1"):
        SUITE.parts("wall-2")


def images_of(rendered: list[Any]) -> np.ndarray:
    return np.stack([one[0] if is_pair(one) else one for one in rendered])


@pytest.mark.parametrize(
    "name",
    [pytest.param(s, marks=pytest.mark.thorough if s in MITSUBA else ()) for s in SUITE.scenes],
)
def test_every_scene(name: str) -> None:
    for start, package in NEEDS.items():
        if name.startswith(start):
            pytest.importorskip(package)
    if name in MITSUBA:
        pytest.importorskip("mitsuba")
    if "povray" in name and shutil.which("povray") is None:
        pytest.skip("needs the program povray")
    scene = SUITE.scenes[name]
    problem = foreign.make(name, len(scene.targets) - 1)
    truth, target = problem.truth, problem.target
    assert target.ndim == 3 and target.shape[2] == 3 and target.dtype == np.float32
    assert target.min() >= 0 and target.max() <= 1
    assert truth is not None and truth.shape == (problem.dim,)
    assert truth.min() >= 0 and truth.max() <= 1
    assert problem.error(truth) <= ERRORS_AT_TRUTH.get(name, 1e-9) < scene.solved
    assert problem.error(np.full(problem.dim, 0.5)) > scene.solved
    rendered = problem.render(np.stack([truth, truth]), seed=[0, 0])
    images = images_of(rendered)
    assert images.shape == (2, *target.shape)
    np.testing.assert_array_equal(*images)
    assert ((images[0] - target) ** 2).mean() > 1e-5, "the renderer drew the target"
    for one in filter(is_pair, rendered):
        assert one[1].shape == target.shape[:2] and 0 <= one[1].min() < one[1].max() <= 1


@pytest.mark.parametrize("name", ["board", "wall", "coin", "arm_camera", "texture", "rings"])
def test_problems_are_fixed_and_differ(name: str) -> None:
    first, other = foreign.make(name, 0), foreign.make(name, 1)
    foreign.make.cache_clear()
    again = foreign.make(name, 0)
    np.testing.assert_array_equal(first.target, again.target)
    assert not np.array_equal(first.target, other.target)


def prepared(optimizer: Any, problem: str = "coin-2", **settings: Any) -> harness.Run:
    return prepare(problem, optimizer, task_options={"suite": SUITE.name}, **settings)


@pytest.mark.parametrize("options", [{}, {"photo": True}])
def test_fide_compares_by_itself(options: dict[str, Any]) -> None:
    run = prepared("fide", budget=60, options=options)
    result = run.execute()
    assert isinstance(run.optimizer, FIDE)
    kept = run.optimizer.state.kept
    assert (kept is not None) == bool(options)
    assert kept is None or not kept.given.any()
    best = run.optimizer.best
    assert best is not None and result.x_best is not None
    np.testing.assert_array_equal(best.x, result.x_best)
    errors = result.metrics["error"]
    assert len(errors) == len(result.improvements)
    assert errors[-1] == result.judged["error"] == foreign.make("coin", 2).error(result.x_best)


@pytest.mark.parametrize(
    ("problem", "light"),
    [("coin-2", "exposure"), ("board-0", "exposure"), ("arm_occluder-0", None)],
)
def test_others_are_told_what_photo_compares(
    problem: str, light: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    task, told = foreign.make(*SUITE.parts(problem)), []
    X, other = np.full((2, task.dim), 0.4), optimizers.make("random", task.dim, task.target)
    monkeypatch.setattr(other, "tell", lambda *given: told.append(given))
    rendered = task.render(X)
    how = Foreign(TaskInfo.of(task), task.target, "mse", other)
    plain, losses = how.tell(other, X, rendered, Record())
    [(_, images, same)] = told
    fide = FIDE(task.dim, task.target, photo=True, photometric=light, seed=0)
    np.testing.assert_allclose(losses, fide.tell(X, rendered))
    np.testing.assert_array_equal(losses, same)
    np.testing.assert_allclose(images, np.clip(fide.adjust(rendered), 0, 1), atol=1e-6)
    np.testing.assert_array_equal(plain, images_of(rendered))


def test_a_run_goes_on_as_if_it_had_not_stopped(tmp_path: Path) -> None:
    how: Any = {"options": {"photo": True}, "seed": 3, "checkpoint_every": 0}
    whole = prepared("fide", budget=90, **how).execute()
    prepared("fide", budget=45, out=tmp_path, **how).execute()
    again = prepared("fide", budget=90, out=tmp_path, resume=True, **how).execute()
    np.testing.assert_array_equal(again.losses, whole.losses)
    np.testing.assert_array_equal(again.metrics["error"], whole.metrics["error"])


def test_an_error_must_stay_low_to_the_end() -> None:
    at = {"renders": np.array([1.0, 4.0, 9.0, 12.0])}
    errors = {"error": np.array([5.0, 1.0, 3.0, 2.0])}
    curve = Curve(at, {"renders": 20.0}, np.array([4.0, 3.0, 2.0, 1.0]), errors)
    assert curve.reaches("renders", 3.0) == 4
    assert [curve.reaches("renders", most, "error") for most in (1, 2, 3, 5)] == [np.inf, 12, 4, 1]
    assert curve.loss_at("renders", 5, "error") == 1


@pytest.mark.figures
def test_a_part_from_the_command_line(tmp_path: Path, capsys: Any) -> None:
    words = ["compare", "--suite", SUITE.name, "--scenes", "wall", "--targets", "1"]
    words += ["--budget", "20", "--optimizers", "cma,fide:photo=true", "--out", str(tmp_path)]
    assert main(words) == 0
    printed = capsys.readouterr()
    assert "2 runs of 20 renders" in printed.err
    assert "1 of 134 problems" in printed.out
    words = ["run", "wall-1", "--suite", SUITE.name, "--budget", "20", "--optimizer", "cma"]
    assert main([*words, "--out", str(tmp_path / "one")]) == 0
    assert "which no optimizer has seen" in capsys.readouterr().out
