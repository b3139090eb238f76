"""A user's renderer as a task of `fide run` and `fide compare`."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

from fide_plugins import FIDE, Choice, Float, Int, Space

from .conftest import fide, one_line


@pytest.mark.usefixtures("scene")
def test_run_searches_the_space_and_records_it(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--budget", 24, "--task-seed", 3, "--out", "out", "--json"]
    assert fide("run", "scene.py:render", *words) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (result["task"], result["dim"], result["task_seed"]) == ("scene.py:render", 4, 3)
    settings = json.loads(Path("out/run.json").read_text())["settings"]
    space = Space(
        x=Float(-1, 1, unit="m"), gray=Float(0.01, 1, log=True), rows=Int(1, 4),
        shape=Choice("disk", "square"),
    )  # fmt: skip
    assert Space.from_dict(settings["space"]) == space
    assert settings["size"] == [12, 16]
    (checkpoint,) = Path("out").glob("optimizer-*.ckpt")
    assert FIDE.load(checkpoint).space == space  # integers and choices are searched as such
    assert fide("run", "scene.py:render", *words, "--resume") == 0


def test_arguments_of_the_fit_are_no_options(
    target: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("dim", "target", "seed"):
        words = ["fit", target.name, "--renderer", "scene.py:render", "--set", f"{name}=3"]
        assert fide(*words, "--out", "out") == 2
        assert f"{name} is no option of the optimizer, but an argument" in one_line(capsys)
        assert not Path("out").exists()


DRAW = """
import sys
import numpy as np
from PIL import Image
from scene import render
x, gray, rows, shape, out = sys.argv[1:]
image = render({"x": float(x), "gray": float(gray), "rows": int(rows), "shape": shape})
Image.fromarray(np.rint(image * 255).astype(np.uint8)).save(out)
"""
COMMAND = f"{sys.executable} draw.py {{x:.6f}} {{gray}} {{rows}} {{shape}} {{out}}"


@pytest.fixture
def program(scene: Path) -> Path:
    """``draw.py``, a program with the image of ``scene.py``, and its ``space.toml``."""
    Path("space.toml").write_text(
        "[x]\nlow = -1\nhigh = 1\n[gray]\nlow = 0.01\nhigh = 1\n"
        '[rows]\ntype = "int"\nlow = 1\nhigh = 4\n[shape]\nvalues = ["disk", "square"]\n'
    )
    (scene.parent / "draw.py").write_text(DRAW)
    return scene.parent


@pytest.mark.usefixtures("program")
def test_run_takes_a_program(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--command", COMMAND, "--space", "space.toml", "--timeout", "2m", "--budget", 5]
    assert fide("run", *words, "--optimizer", "random", "--task-seed", 2, "--json") == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    name = Path(sys.executable).name
    assert (result["task"], result["dim"], result["evaluations"]) == (name, 4, 5)
    (record,) = Path("runs").glob("*/run.json")
    options = json.loads(record.read_text())["settings"]["task_options"]
    assert options == {"space": "space.toml", "command": COMMAND, "timeout": 120.0}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["scene.py"], "no renderer 'scene.py'.*; it has render, render_x"),
        (["scene.py:rendr"], "'rendr' in .*scene.py must be .*it has render"),
        (["nowhere.py:render"], "no file '/.*/nowhere.py'; write FILE.py:NAME"),
        (["scene.py:render", "--space", "no.toml"], "No such file or directory: 'no.toml'"),
        (["scene.py:render", "--space", "bad.toml"], "bad.toml: .a. hihg: unknown key.*'high'"),
        (["scene.py:render", "--task-set", "cells=3"], "has no option 'cells'; it has space"),
        (["bare.py:render"], "parameters of bare.py:render are unknown; .*--space FILE.toml"),
        (["voronoi", "--space", "bad.toml"], "voronoi has no option 'space'"),
        (
            ["voronoi", "--target", "p.png"],
            "--target is for .* voronoi makes its own target; leave",
        ),
    ],
)
def test_wrong_usage_is_one_line(
    words: list[str], message: str, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (scene.parent / "bad.toml").write_text('[a]\ntype = "float"\nlow = 0\nhihg = 1\n')
    (scene.parent / "bare.py").write_text("def render(params): ...")
    assert fide("run", *words) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert captured.err.startswith("fide run: ")
    assert re.search(message, captured.err), captured.err
