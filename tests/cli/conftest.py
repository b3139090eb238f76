"""The command as a user types it, and a renderer of theirs: a disk, an integer and a choice."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fide_plugins.cli import main

KEYS = [
    "task", "optimizer", "loss", "seed", "task_seed", "dim", "budget", "evaluations", "best_loss",
    "mse", "wall_s", "render_s", "overhead_s", "x_best",
]  # fmt: skip

SCENE = """
import numpy as np
from fide_plugins import Choice, Float, Int, Space

space = Space(
    x=Float(-1, 1, unit="m"), gray=Float(0.01, 1, log=True), rows=Int(1, 4),
    shape=Choice("disk", "square"),
)
v, u = np.mgrid[-1:1:12j, -1:1:16j]


def render(p):
    far = np.hypot(u - p["x"], v) if p["shape"] == "disk" else np.maximum(abs(u - p["x"]), abs(v))
    lines = 0.25 + 0.25 * np.cos(np.pi * p["rows"] * v)
    return np.where(far < 0.5, p["gray"], lines)


def render_x(x):
    return np.full((12, 16), x[0] * x[1])


def fails(p):
    if p["x"] < 0:
        raise ValueError("x is below 0")
    return render(p)


render_x.space = 2
"""


def fide(*words: object) -> int:
    """Exit code of ``fide WORDS``."""
    return main([str(word) for word in words])


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line of standard error, with nothing on standard output."""
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    return captured.err


def summary(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """What ``--json`` printed."""
    result: dict[str, Any] = json.loads(capsys.readouterr().out.splitlines()[-1])
    return result


def last_line(capsys: pytest.CaptureFixture[str]) -> str:
    """Last line of standard error."""
    return capsys.readouterr().err.splitlines()[-1]


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """``scene.py`` in the current folder, with an image of 16 x 12 pixels."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "scene.py"
    path.write_text(SCENE)
    return path


@pytest.fixture
def target(scene: Path) -> Path:
    """``target.png``: what the renderer draws for x = 0.3 m, gray 0.8, 3 rows and a square."""
    names: dict[str, Any] = {}
    exec(SCENE, names)
    image = names["render"]({"x": 0.3, "gray": 0.8, "rows": 3, "shape": "square"})
    path = scene.parent / "target.png"
    Image.fromarray(np.rint(image * 255).astype(np.uint8)).save(path)
    return path
