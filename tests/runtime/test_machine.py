"""The machine: cores, extras, OpenCV, and what works without matplotlib."""

from __future__ import annotations

import os
import re
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from fide_lab.figures import new_figure
from fide_plugins import Float, Space, fit
from fide_plugins.cli import main
from fide_plugins.errors import DependencyError
from fide_plugins.runtime.machine import EXTRAS, cores, missing


@pytest.fixture(autouse=True)
def _sixteen(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that may run on 16 cores."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)), raising=False)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, 16),
        ("max 100000\n", 16),
        ("250000 100000\n", 3),
        ("50000 100000\n", 1),
        ("3200000 100000\n", 16),  # more than there are
        ("odd\n", 16),
    ],
)
def test_a_quota_of_a_container_counts(tmp_path: Path, text: str | None, expected: int) -> None:
    if text is not None:
        (tmp_path / "cpu.max").write_text(text)
    assert cores(tmp_path / "cpu.max") == expected


# -- the extras named in errors are those of the distribution --------------------------------------


NAME = re.compile(r"[\w.-]+")
PROJECT = Path(__file__).parents[2] / "pyproject.toml"
NOT_FOR_USERS = {"all", "dev", "docs", "examples", "release"}


def test_the_extras_are_those_that_are_declared() -> None:
    project = tomllib.loads(PROJECT.read_text("utf-8"))["project"]
    found = {
        extra: {NAME.findall(package)[0].lower() for package in packages}
        for extra, packages in project["optional-dependencies"].items()
    }
    ours = {extra: {name.lower() for name in packages} for extra, packages in EXTRAS.items()}
    assert ours == {name: found[name] for name in found.keys() - NOT_FOR_USERS}
    assert "matplotlib" in found["dev"]
    words = "x: pip install mujoco (or this distribution with its extra robot: pip install"
    assert str(missing("robot", "x")).startswith(words)


# -- without matplotlib, which is an extra, everything but figures works ---------------------------


NAMES = r"pip install matplotlib \(or .* its extra plot: pip install 'fide-plugins\[plot\]'\)"
SCENE = """
import numpy as np
from fide_plugins import Float, Space
space = Space(gray=Float(0, 1))
def render(p):
    return np.full((8, 8), p["gray"])
"""


def draw(p: dict[str, float]) -> np.ndarray:
    return np.full((8, 8), p["gray"])


@pytest.fixture
def plain_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """As after `pip install fide-plugins`."""
    for name in [*sys.modules, "matplotlib", "matplotlib.figure"]:
        if name.partition(".")[0] == "matplotlib":
            monkeypatch.setitem(sys.modules, name, None)


@pytest.mark.figures
@pytest.mark.usefixtures("plain_install")
def test_a_fit_writes_all_but_its_figure(tmp_path: Path) -> None:
    with pytest.warns(RuntimeWarning, match=f"summary.png is left out: .* {NAMES}"):
        result = fit(draw, np.full((8, 8), 0.4), Space(gray=Float(0, 1)), budget=20, workers=0,
                     out=tmp_path / "run")  # fmt: skip
    files = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"best.png", "target.png", "curve.csv", "run.json"} <= files
    assert "summary.png" not in files
    assert "losses" not in result._repr_html_() and "gray" in result._repr_html_()
    with pytest.raises(DependencyError, match=NAMES):
        result.plot()
    with pytest.raises(DependencyError, match=NAMES):
        new_figure(1, 1)


@pytest.mark.figures
@pytest.mark.filterwarnings("default")
@pytest.mark.usefixtures("plain_install")
def test_commands_say_what_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plain_scene.py").write_text(SCENE)
    from fide_plugins.validation.images import save

    save("target.png", np.full((8, 8), 0.4, np.float32))
    words = "fit target.png --renderer plain_scene.py:render --workers 0 --budget 20 --out run"
    assert main(words.split()) == 0
    told = capsys.readouterr()
    assert "summary.png is left out: figures need matplotlib" in told.err
    assert "look at run/best.png" in told.out
    assert main(["check", "plain_scene.py:render", "--workers", "1", "--out", "check"]) == 0
    told = capsys.readouterr()
    assert "check.png is left out" in told.err and "look at" not in told.out
    assert main(["solutions", "run"]) == 0
    assert "solutions.png is left out" in capsys.readouterr().err
    assert main(["solutions", "run", "-o", "answers.png"]) == 2
    assert "extra plot" in capsys.readouterr().err
