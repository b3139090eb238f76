"""`fide fit` with a renderer of one's own: a function of a file, or a program."""

from __future__ import annotations

import json
import re
import shlex
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fide_plugins import Space, load_run
from fide_plugins.renderers import FunctionRenderer

from .conftest import fide, summary

PROGRAM = """
import sys
out, gray, rows = sys.argv[1:4]
if float(gray) < 0.4:
    sys.exit("it is too dark")
lines = b"".join(bytes([int(255 * float(gray) * (i % int(rows) == 0))] * 8) for i in range(6))
open(out, "wb").write(b"P5 8 6 255\\n" + lines)
"""
SLOW = """
import time
from scene import render as draw, space

def render(params):
    time.sleep(0.02)
    return draw(params)
"""
SPACE = """
[gray]
type = "float"
low = 0
high = 1

[rows]
type = "int"
low = 1
high = 4
"""


@pytest.fixture
def program(target: Path) -> str:
    """Command line of a program that draws 8 x 6 pixels; its target is lines.png."""
    folder = target.parent
    (folder / "program.py").write_text(PROGRAM)
    (folder / "space.toml").write_text(SPACE)
    draw = f"{shlex.quote(sys.executable)} -I -S program.py"
    subprocess.run(shlex.split(f"{draw} lines.ppm 0.6 3"), check=True, cwd=folder)
    Image.open(folder / "lines.ppm").save(folder / "lines.png")
    return f"{draw} {{out}} {{gray}} {{rows}}"


# -- a fit -----------------------------------------------------------------------------------------


@pytest.mark.usefixtures("target")
def test_a_function_is_fitted_and_the_json_names_parameters(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ["--renderer", "scene.py:render", "--workers", 0, "--budget", 40, "--out", "out"]
    assert fide("fit", "target.png", *words, "--json") == 0
    result = summary(capsys)
    assert {"task", "best_loss", "mse", "x_best", "wall_s", "params", "status"} <= set(result)
    assert (result["task"], result["evaluations"]) == ("scene.py:render", 40)
    space = FunctionRenderer("scene.py:render").space
    assert isinstance(space, Space)
    assert result["params"] == space.decode(result["x_best"])
    assert Path("out/best.png").is_file() and Path("out/target.png").is_file()
    curve = np.loadtxt("out/curve.csv", delimiter=",", skiprows=1)[:, 1]
    best = json.loads(Path("out/run.json").read_text())["totals"]["best_loss"]
    assert best == result["best_loss"] == curve.min()


@pytest.mark.usefixtures("target")
def test_a_finished_fit_goes_on_with_a_larger_budget(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["fit", "target.png", "--renderer", "scene.py:render", "--workers", 0, "--json"]
    assert fide(*words, "--budget", 60, "--out", "whole") == 0
    whole = summary(capsys)
    assert fide(*words, "--budget", 25, "--out", "out") == 0
    assert fide(*words, "--budget", 60, "--out", "out", "--resume") == 0
    captured = capsys.readouterr()
    assert "continuing out after 25 renders" in captured.err
    result = json.loads(captured.out.splitlines()[-1])
    assert (result["evaluations"], result["x_best"]) == (60, whole["x_best"])
    assert fide(*words, "--budget", 70, "--out", "out") == 2  # not without --resume
    assert "resume it (--resume)" in capsys.readouterr().err


@pytest.mark.filterwarnings("always:a render failed")
def test_a_program_is_fitted_without_a_shell(
    program: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["lines.png", "--command", program, "--space", "space.toml", "--workers", 1]
    words += ["--budget", 25, "--until", "budget"]
    assert fide("fit", *words, "--json", "--out", "out") == 0
    captured = capsys.readouterr()
    result = json.loads(captured.out.splitlines()[-1])
    assert set(result["params"]) == {"gray", "rows"} and result["evaluations"] == 25
    assert result["failures"] > 0  # the first one is shown whole
    assert captured.err.count("ended with exit code 1") == captured.err.count("to see it, run") == 1
    assert "it is too dark" in captured.err


@pytest.mark.usefixtures("target")
def test_the_end_says_each_thing_once_in_units(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["fit", "target.png", "--renderer", "scene.py:render", "--workers", 0, "--seed", 3]
    assert fide(*words, "--budget", 60, "--until", "budget", "--out", "end") == 0
    out = capsys.readouterr().out
    params = load_run("end").params
    assert re.search(r"^  x +-?[\d.]+ ± [\d.]+ m$", out, re.MULTILINE)
    assert re.search(rf"^  shape +{params['shape']}$", out, re.MULTILINE)
    for once in ("loss", "60 renders", "stopped", "end/summary.png", "fide solutions end"):
        assert out.count(once) == 1, out
    assert Path("end/summary.png").exists()


@pytest.mark.usefixtures("target")
def test_a_picture_is_reduced_to_the_renderers_size(capsys: pytest.CaptureFixture[str]) -> None:
    with Image.open("target.png") as image:
        image.resize((160, 120)).save("large.png")
    words = ["--renderer", "scene.py:render", "--workers", 0, "--budget", 5]
    assert fide("fit", "large.png", *words) == 2
    err = capsys.readouterr().err
    assert "the first render gave no image that fits" in err and "(12, 16" in err
    assert not Path("runs").exists()
    assert fide("fit", "large.png", *words, "--size", 16) == 0


@pytest.mark.thorough
def test_ctrl_c_saves_and_resume_goes_on(
    target: Path, forked_command: Callable[..., Any], capsys: pytest.CaptureFixture[str]
) -> None:
    (target.parent / "slow.py").write_text(SLOW)
    words = ["fit", "target.png", "--renderer", "slow.py:render", "--workers", "0", "--out", "out"]
    command = forked_command(*words, "--budget", 100_000)
    command.wait_until(Path("out/run.ckpt").exists)
    code, err = command.stop(signal.SIGINT)
    assert code == 130, err
    assert "stopped by SIGINT after" in err and "--resume" in err
    assert "\nbest loss" in err and "look at out/summary.png" in err
    assert Path("out/summary.png").exists()
    done = json.loads(Path("out/run.json").read_text())["totals"]["evaluations"]
    assert done > 0
    assert fide(*words, "--budget", done + 5, "--resume", "--json") == 0
    assert summary(capsys)["evaluations"] == done + 5


@pytest.mark.parametrize(
    "what", [["--renderer", "scene.py:render", "--workers", 0], ["--model", "voronoi"]]
)
def test_live_shows_the_fit_while_it_goes_on(
    what: list[object],
    target: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    seen: list[dict[str, Any]] = []

    def visit(url: str) -> None:
        with urllib.request.urlopen(url + "state.json", timeout=20) as answer:
            seen.append({"url": url, **json.load(answer)})

    monkeypatch.setattr("fide_lab.cli.watch_command.open_page", visit)
    assert fide("fit", target, *what, "--budget", 20, "--out", "out", "--live", "--json") == 0
    captured = capsys.readouterr()
    (page,) = seen
    assert page["state"] == "running" and page["url"] in captured.err
    assert json.loads(captured.out)["evaluations"] == 20
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(page["url"], timeout=20)


# -- wrong usage -----------------------------------------------------------------------------------

COMMAND = ["target.png", "--command"]
RENDERER = ["target.png", "--renderer"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([*RENDERER, "broken.py:render"], "(?s)cannot be imported.*line 1.*ZeroDivisionError"),
        (["no.png", *RENDERER[1:], "scene.py:render"], "no image file at 'no.png'"),
        (
            [*RENDERER, "scene.py:render", "--optimizer", "cma"],
            "--optimizer has no meaning",
        ),
        ([*RENDERER, "scene.py:render", "--time", "soon"], "time must be .* '10m'.*not 'soon'"),
        ([*COMMAND, "ls {out} {gray} {rows}"], "--command needs --space FILE.toml"),
        ([*COMMAND, "ls {out}", "--space", "typo.toml"], "typo.toml: .gray. hihg: unknown key"),
        (
            [*COMMAND, "a {out}", "--command", "b {out}", "--space", "space.toml"],
            "2 commands",
        ),
        (
            ["target.png", "--model", "voronoi", "--time", "5m"],
            "--time has no meaning",
        ),
    ],
)
@pytest.mark.usefixtures("program")
def test_wrong_usage_is_said_before_anything_is_written(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("broken.py").write_text("1 / 0")
    Path("typo.toml").write_text('[gray]\ntype = "float"\nlow = 0\nhihg = 1\n')
    more = [] if "--model" in words or len(words) == 1 else ["--workers", 0]
    assert fide("fit", *words, *more) == 2
    err = capsys.readouterr().err
    assert err.startswith("fide fit: ") and re.search(message, err), err
    assert not Path("runs").exists()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("import time; time.sleep(600)", "the first render failed: it did not end within 2 s"),
        ("return None", "is not an image|must be|None"),
        ("import os; os._exit(7)", "the first render failed: .*died with exit code 7"),
    ],
)
@pytest.mark.usefixtures("target")
def test_a_renderer_that_cannot_render_is_found_by_the_first_render(
    body: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("bad.py").write_text(f"from scene import space\ndef render(p):\n    {body}\n")
    timeout = 2 if "sleep" in body else 60
    words = ["--renderer", "bad.py:render", "--workers", 1, "--timeout", timeout, "--budget", 4]
    assert fide("fit", "target.png", *words) in (1, 2)
    assert re.search(message, " ".join(capsys.readouterr().err.split()))
    assert not Path("runs").exists()


RING = """
[inner]
type = "float"
low = 0.05
high = 0.45

[outer]
type = "float"
low = 0.05
high = 0.45
"""
DRAWS_RING = """
import sys
import numpy as np
from PIL import Image

def render(p):
    if p["inner"] >= 0.6 * p["outer"]:
        raise ValueError("wall too thin")
    v, u = np.mgrid[0:8, 0:12]
    d = np.hypot(u - 6, v - 4) / 8
    return (d > p["inner"]) * (d < p["outer"]) * 1.0

if __name__ == "__main__":
    image = render({"inner": float(sys.argv[2]), "outer": float(sys.argv[3])})
    Image.fromarray((255 * image).astype("uint8")).save(sys.argv[1])
"""


@pytest.fixture
def ring(target: Path) -> None:
    """ring.py, which draws only rings with a thick wall, and ring.png."""
    Path("ring.py").write_text(DRAWS_RING)
    subprocess.run([sys.executable, "ring.py", "ring.png", "0.1", "0.4"], check=True)


@pytest.mark.parametrize("constraint", ['wall = "inner < 0.6 * outer"', ""])
@pytest.mark.filterwarnings("always:a render failed")
@pytest.mark.usefixtures("ring")
def test_a_space_with_invalid_parameters_is_fitted(
    constraint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where only the renderer knows which are valid, and the middle is not."""
    Path("ring.toml").write_text(RING + ("\n[constraints]\n" + constraint if constraint else ""))
    words = ["--renderer", "ring.py:render", "--space", "ring.toml", "--workers", 0, "--seed", 0]
    assert fide("fit", "ring.png", *words, "--budget", 40, "--out", "out", "--json") == 0
    told = summary(capsys)
    assert told["params"]["inner"] < 0.6 * told["params"]["outer"]
    assert told["failures"] == 0 or not constraint


@pytest.mark.parametrize(
    ("constraint", "words", "code", "message"),
    [
        ("inner < 0.6 * outr", [], 2, "ring.toml: constraint wall = .*unknown parameter 'outr'"),
        ("inner > 2", [], 2, r"no valid point was found.*wall \(inner > 2\)"),
        ("inner < 0.6 * outer", ["--set", "x0=[1,0]"], 2, "x0 is not valid: it violates wall"),
        ("inner < 1", ["--max-failures", 2], 2, "max_failures"),
    ],
)
@pytest.mark.usefixtures("ring")
def test_invalid_starts_and_constraints_are_refused_before_anything_is_written(
    constraint: str,
    words: list[Any],
    code: int,
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    Path("ring.toml").write_text(f'{RING}\n[constraints]\nwall = "{constraint}"')
    given = ["--renderer", "ring.py:render", "--space", "ring.toml", "--workers", 0, "--seed", 0]
    assert fide("fit", "ring.png", *given, *words) == code
    assert re.search(message, " ".join(capsys.readouterr().err.split()))
    assert not Path("runs").exists()
