"""`fide solutions`, `fide check` and `fide watch`."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import urllib.request
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fide_lab.cli.solutions_command import own_encoder
from fide_lab.solutions import read
from fide_plugins import FIDE, Solution, fit, images
from fide_plugins.errors import CheckpointError
from fide_plugins.renderers import FunctionRenderer

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
    render, encoder = FunctionRenderer("scene.py:render"), own_encoder("features.py:blocks")
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
    for other, message in {"others": "encoder", "block": "it has blocks"}.items():
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


# -- `fide check` ----------------------------------------------------------------------------------


PROGRAM = """
import sys
out, gray = sys.argv[1:3]
if float(gray) < 0.4:
    sys.exit("it is too dark")
open(out, "wb").write(b"P5 8 6 255\\n" + bytes([int(255 * float(gray))] * 47) + b"\\0")
"""


@pytest.mark.usefixtures("scene")
def test_a_report_and_a_picture(capsys: pytest.CaptureFixture[str]) -> None:
    assert fide("check", "scene.py:render", "--workers", 1) == 0
    captured = capsys.readouterr()
    lines = captured.out.splitlines()
    assert re.fullmatch(r"scene.py:render: 4 parameters, \d+ renders in .* m?s", lines[0])
    assert lines[1] == "image     16 x 12 pixels, gray, float64, values 0 to 1"
    table = lines[lines.index("") + 2 :]
    assert [line.split()[0] for line in table[:4]] == ["x", "gray", "rows", "shape"]
    assert "plan 2,000 renders for 4 parameters" in lines[-2]
    assert lines[-1] == "look at runs/check-scene/check.png" and not captured.err
    with Image.open("runs/check-scene/check.png") as picture:
        assert picture.width > 4 * 1.35 * 110  # inches of four panels, dots per inch


@pytest.mark.usefixtures("scene")
def test_json_is_one_object(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--workers", 1, "--out", "seen", "--json"]
    assert fide("check", "scene.py:fails", *words) == 0
    (line,) = capsys.readouterr().out.splitlines()
    found = json.loads(line)
    assert found["picture"] == "seen/check.png" and Path("seen/check.png").is_file()
    assert found["shapes"] == [[[12, 16, 1]]] and found["noise"] == 0
    assert [one["name"] for one in found["parameters"]] == ["x", "gray", "rows", "shape"]
    assert found["parameters"][0]["values"] == ["-1", "0", "1"]
    (failure,) = found["failures"]
    assert failure["count"] >= 1 and "x=-" in failure["params"]


@pytest.mark.usefixtures("scene")
def test_a_program_whose_failures_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    Path("program.py").write_text(PROGRAM)
    Path("space.toml").write_text('[gray]\ntype = "float"\nlow = 0.0\nhigh = 1.0\n')
    command = f"{shlex.quote(sys.executable)} -I -S program.py {{out:.ppm}} {{gray}}"
    words = ["--command", command, "--space", "space.toml", "--workers", 1]
    assert fide("check", *words) == 0
    out = capsys.readouterr().out
    assert "ended with exit code 1" in out and "it is too dark" in out
    assert re.search(r"gray +0 to 1 +0\.\d+, no image at 0$", out, re.MULTILINE)


@pytest.mark.usefixtures("scene")
def test_a_renderer_that_never_gives_an_image(capsys: pytest.CaptureFixture[str]) -> None:
    Path("never.py").write_text("space = 2\n\ndef render(x):\n    return None\n")
    assert fide("check", "never.py:render") == 1
    captured = capsys.readouterr()
    assert "render returned None; let it return its image" in captured.out
    assert "look at" not in captured.out and not Path("runs").exists()


@pytest.mark.usefixtures("scene")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "one of the arguments RENDERER --command is required"),
        (["scene.py:rendr"], "it has render"),
        (["no.py:render"], "did you mean 'scene.py'"),
        (["nope"], "no task is named 'nope'"),
        (["--command", "ls {out}"], "--command needs --space FILE.toml"),
        (["ball", "--space", "typo.toml"], "there is no file"),
        (["scene.py:render", "--timeout", "soon"], "timeout must be"),
        (["scene.py:render", "--workers", "0"], "a whole number >= 1"),
    ],
)
def test_wrong_usage(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert fide("check", *words) == 2
    assert message in one_line(capsys)


# -- `fide watch` ----------------------------------------------------------------------------------


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_it_serves_until_it_is_stopped(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "fide_plugins", "watch", str(tmp_path), "--no-browser"]
    heard = partial(
        signal.signal, signal.SIGINT, signal.default_int_handler
    )  # background jobs ignore it
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=heard) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        url = line.split()[0]
        assert url.startswith("http://127.0.0.1:") and str(tmp_path) in line
        with urllib.request.urlopen(url + "state.json", timeout=20) as answer:
            assert json.load(answer)["state"] == "not begun"
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 130
