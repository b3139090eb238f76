"""`fide check`: what to know of a renderer before a fit."""

from __future__ import annotations

import json
import re
import shlex
import sys
from pathlib import Path

import pytest
from PIL import Image

from .conftest import fide, one_line

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
    assert found["sizes"] == [[[12, 16, 1]]] and found["deterministic"] is True
    assert [one["name"] for one in found["parameters"]] == ["x", "gray", "rows", "shape"]
    assert found["parameters"][0]["values"] == ["-1", "0", "1"]
    (failure,) = found["failures"]
    assert failure["count"] >= 1 and "x=-" in failure["params"]


@pytest.mark.usefixtures("scene")
def test_a_function_of_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    assert fide("check", "scene.py:render_x", "--workers", 1, "--json") == 0
    numbers = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in numbers["parameters"]] == ["x[0]", "x[1]"]
    assert numbers["center"] is None


@pytest.mark.usefixtures("scene")
def test_a_built_in_task(capsys: pytest.CaptureFixture[str]) -> None:
    assert fide("check", "ball", "--workers", 1, "--json") == 0
    assert json.loads(capsys.readouterr().out)["renderer"] == "ball"


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
        (["scene.py:rendr"], "did you mean 'render'"),
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
