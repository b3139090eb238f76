"""A run directory as a fit leaves it in the middle, and a server of it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fide_plugins.watch import Server, serve


def write_picture(path: Path, value: int) -> None:
    Image.fromarray(np.full((12, 16, 3), value, np.uint8)).save(path)


def write_live(directory: Path, evaluations: int, best: float) -> None:
    live = {
        "evaluations": evaluations,
        "budget": 500,
        "seconds": 75.2,
        "best_loss": best,
        "parameters": [["azimuth", "12.5", "deg"], ["floor", "<b>wood</b>", ""]],
        "workers": 8,
        "busy": 7,
        "failures": 2,
        "sentence": "improving: the loss fell by half",
    }
    (directory / "live.json").write_text(json.dumps(live))


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    out = tmp_path / "run"
    out.mkdir()
    settings = {"task": "scene.py:render", "optimizer": "fide", "loss": "mse"}
    (out / "run.json").write_text(json.dumps({"state": "running", "settings": settings}))
    lines = ["evaluation,loss,best_loss,seconds", "0,0.5,0.5,0.1", "1,inf,0.5,0.2", "2,0.1,0.1,0.3"]
    (out / "curve.csv").write_text("\n".join(lines) + "\n")
    write_picture(out / "target.png", 200)
    write_picture(out / "best.png", 180)
    write_live(out, 120, 0.002)
    (tmp_path / "secret.png").write_bytes((out / "best.png").read_bytes())
    return out


@pytest.fixture
def server(directory: Path) -> Iterator[Server]:
    made, _ = serve(directory)
    yield made
    made.close()
