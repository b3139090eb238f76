"""A run directory as a fit leaves it in the middle, and a server of it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fide_lab.watch import Server, serve
from fide_plugins import Choice, Float, Space
from fide_plugins.recording.record import Record
from fide_plugins.runtime import checkpoint

SPACE = Space(azimuth=Float(0, 25, unit="deg"), floor=Choice("<b>wood</b>", "stone"))


def write_picture(path: Path, value: int) -> None:
    Image.fromarray(np.full((12, 16, 3), value, np.uint8)).save(path)


def write_curve(directory: Path, evaluations: int, best: float) -> None:
    """As many evaluations after 75 seconds, of which the last one is the best."""
    rows = [(0.5, 0.5, 0.1), (np.inf, 0.5, 0.2), (0.1, 0.1, 0.3)]
    rows += [(1.0, 0.1, 75.2)] * (evaluations - 4) + [(best, best, 75.2)]
    lines = [f"{i},{loss},{b},{s}" for i, (loss, b, s) in enumerate(rows)]
    table = "\n".join(["evaluation,loss,best_loss,seconds", *lines]) + "\n"
    (directory / "curve.csv").write_text(table)


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    out = tmp_path / "run"
    out.mkdir()
    settings = {
        "task": "scene.py:render", "optimizer": "fide", "loss": "mse", "dim": SPACE.dim,
        "size": [12, 16], "space": SPACE.to_dict(),
    }  # fmt: skip
    run = {"format": 2, "state": "running", "settings": settings, "limits": {"budget": 500}}
    (out / "run.json").write_text(json.dumps(run))
    write_curve(out, 120, 0.002)
    write_picture(out / "target.png", 200)
    write_picture(out / "best.png", 180)
    record = Record(failures=2)
    x = SPACE.encode({"azimuth": 12.5, "floor": "<b>wood</b>"})
    record.add_one(x, np.zeros((12, 16, 3), np.float32), 0.002)
    record.pending = np.zeros((0, SPACE.dim))
    state = {"record": record.state(), "optimizer": "optimizer-1-0.ckpt"}
    checkpoint.write(out / "run.ckpt", "run", state)
    (tmp_path / "secret.png").write_bytes((out / "best.png").read_bytes())
    return out


@pytest.fixture
def server(directory: Path) -> Iterator[Server]:
    made, _ = serve(directory)
    yield made
    made.close()
