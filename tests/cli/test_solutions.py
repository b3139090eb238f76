"""`fide solutions`: several answers side by side."""

from __future__ import annotations

import json
import re
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fide_plugins import FIDE, Solution, fit, images, solutions as pictures
from fide_plugins.encoders.own import referenced
from fide_plugins.errors import CheckpointError
from fide_plugins.fitting.pictures import side_by_side
from fide_plugins.renderers import FunctionRenderer
from fide_plugins.solutions import figure, read

from .conftest import fide, one_line


def two(optimizer: FIDE, k: int = 5) -> list[Solution]:
    """The best candidate, and another one: how many a short fit finds depends on the CPU."""
    assert optimizer.best is not None
    other = Solution(np.array([0.2, 0.8, 0.375, 0.25]), 0.5, 7, space=optimizer.space)
    return [optimizer.best, other][:k]


@pytest.fixture
def run(target: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Directory of a fit with two solutions."""
    monkeypatch.setattr(FIDE, "solutions", two)
    words = ["--renderer", "scene.py:render", "--workers", 0, "--budget", 24, "--out", "out"]
    assert fide("fit", target, *words) == 0
    return Path("out")


def test_all_solutions_are_shown_with_their_own_images(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = read(run)
    assert len(found.solutions) == 2
    render = FunctionRenderer("scene.py:render")
    for solution, image in zip(found.solutions, found.images, strict=True):
        assert image is not None
        np.testing.assert_allclose(image[..., 0], render(solution.params), atol=1e-6)
    np.testing.assert_array_equal(found.target, images.load("target.png"))

    capsys.readouterr()
    assert fide("solutions", run, "-o", "answers.png", "-k", 2) == 0
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"solution +1 +2", lines[0])
    assert [line.split()[0] for line in lines[1:6]] == ["loss", "x", "gray", "rows", "shape"]
    assert lines[-1] == "look at answers.png"

    assert fide("report", run) == 2  # which is of a comparison
    err = capsys.readouterr().err
    assert "out holds a single run" in err and "fide watch out or: fide solutions out" in err
    with Image.open("answers.png") as picture:
        assert picture.width > 2.5 * 2.4 * 110  # inches of three panels, dots per inch

    assert fide("solutions", run, "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert [one["params"] for one in data] == [one.params for one in found.solutions]
    for one, solution in zip(data, found.solutions, strict=True):
        assert one["probability"] == solution.probability
        std = solution.std
        known = None if std is None else [None if np.isnan(s) else s for s in std]
        assert one["std"] == known


def test_hypotheses_near_no_solution_are_told(
    run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    line = "50% of the model's hypotheses are near none of these: probabilities are relative"
    for share in (0.004, 0.5):
        monkeypatch.setattr(FIDE, "elsewhere", lambda self, solutions, share=share: share)
        capsys.readouterr()
        assert fide("solutions", run) == 0
        assert (line in capsys.readouterr().out.splitlines()) == (share == 0.5)


def test_a_fit_of_python_shows_the_best_image_and_says_what_is_not_stored(run: Path) -> None:
    (run / "solutions.ckpt").unlink()
    found = read(run)
    assert found.images[0] is not None and found.images[1] is None
    with Image.open(BytesIO(figure(found))) as picture:
        assert picture.format == "PNG"


def test_a_checkpoint_that_is_replaced_meanwhile_is_read_again(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load, before = FIDE.load, {path.name for path in run.glob("optimizer-*.ckpt")}
    words = ["fit", "target.png", "--renderer", "scene.py:render", "--workers", 0, "--out", run]

    def late(path: Path, **options: Any) -> FIDE:
        monkeypatch.setattr(FIDE, "load", load)
        assert fide(*words, "--budget", 30, "--resume") == 0
        assert not path.exists()
        return load(path, **options)

    monkeypatch.setattr(FIDE, "load", late)
    found = read(run)
    after = {path.name for path in run.glob("optimizer-*.ckpt")}
    assert len(found.solutions) == 2 and not before & after
    for path in run.glob("optimizer-*.ckpt"):
        path.unlink()
    with pytest.raises(FileNotFoundError, match="optimizer-30"):
        read(run)


def test_nothing_in_the_directory_is_executed(run: Path) -> None:
    record = json.loads((run / "run.json").read_text())
    record["command"] = "touch executed"
    record["settings"]["task"] = "trap.py:render"
    (run / "run.json").write_text(json.dumps(record))
    Path("trap.py").write_text("open('executed', 'w')")
    (run / "solutions.ckpt").write_bytes((run / "solutions.ckpt").read_bytes()[:-7])
    with pytest.raises(CheckpointError):
        read(run)
    (run / "solutions.ckpt").unlink()
    assert len(read(run).solutions) == 2
    assert not Path("executed").exists()


def test_images_belong_to_their_points(tmp_path: Path) -> None:
    points = [np.array([0.25, 0.5]), np.array([0.5, 0.25])]
    stored = [np.full((2, 3, 3), gray, np.float32) for gray in (0.25, 0.75)]
    pictures.write_images(tmp_path, points, stored)
    known = pictures.read_images(tmp_path)
    np.testing.assert_array_equal(pictures.image_of(known, points[1]), stored[1])
    assert pictures.image_of(known, np.array([0.5, 0.5])) is None
    wide = side_by_side([np.ones((2, 3, 3), np.float32), np.ones((1, 2, 3), np.float32)])
    assert wide.shape == (2, 5, 3) and wide[1, 3:].max() == 0 and wide[0].min() == 1


ENCODERS = """
def blocks(images):
    return images.reshape(len(images), 3, 4, 4, 4, 3).mean(axis=(2, 4)).reshape(len(images), -1, 3)


def others(images):
    return images[:, ::4, ::4]
"""


def test_a_run_with_an_encoder_of_one_s_own(
    target: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("features.py").write_text(ENCODERS)
    render, encoder = FunctionRenderer("scene.py:render"), referenced("features.py:blocks")
    result = fit(
        render,
        target,
        render.space_or(None),
        budget=40,
        encoder=encoder,
        workers=0,
        seed=0,
        out="own",
    )
    assert fide("solutions", "own") == 2
    assert "--encoder FILE.py:blocks" in one_line(capsys)
    assert fide("solutions", "own", "--encoder", "features.py:blocks", "--json") == 0
    first, *_ = json.loads(capsys.readouterr().out)
    assert result.best is not None and first["loss"] == result.best.loss
    assert first["params"] == result.params
    for other, message in {"others": "encoder", "block": "did you mean 'blocks'?"}.items():
        assert fide("solutions", "own", "--encoder", f"features.py:{other}") == 2
        assert message in one_line(capsys)


@pytest.mark.usefixtures("scene")
def test_directories_without_solutions_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert fide("run", "scene.py:render", "--optimizer", "cma", "--budget", 9, "--out", "cma") == 0
    Path("empty").mkdir()
    for folder, message in {
        "nowhere": "nowhere is no run directory",
        "empty": "empty is no run directory; give one that fide fit or fide run wrote",
        "cma": "cma is a run of cma, which keeps one solution",
    }.items():
        capsys.readouterr()
        assert fide("solutions", folder) == 2
        assert message in capsys.readouterr().err
