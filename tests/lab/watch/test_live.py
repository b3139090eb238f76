"""What a fit and a run write, as the page reads it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fide_lab.watch.snapshot import RunFiles
from fide_plugins import Float, Space
from fide_plugins.fitting.one_call import prepare
from fide_plugins.fitting.stopping import Stopping
from fide_plugins.types import Float32

SPACE = Space(angle=Float(-60, 60, unit="deg"), level=Float(0, 1))


def render(params: dict[str, Any]) -> Float32:
    image = np.full((8, 8, 3), params["level"], np.float32)
    image[:, :4] *= (params["angle"] + 60) / 120
    return image


def test_a_fit_is_shown_while_it_goes_on(tmp_path: Path) -> None:
    seen: list[dict[str, Any]] = []

    def look(event: Any) -> None:
        if event.evaluation == 25:
            seen.append(RunFiles(tmp_path / "run").state())

    prepare(
        render, render({"angle": 30.0, "level": 0.8}), SPACE, workers=0, seed=0, callbacks=look,
        stopping=Stopping(40, until="budget"), out=tmp_path / "run", checkpoint_every=0,
    ).execute()  # fmt: skip
    (during,) = seen
    assert during["state"] == "running"
    assert during["evaluations"] == 25 and during["budget"] == 40
    losses = [loss for _, loss in during["improvements"]]
    assert losses == sorted(losses, reverse=True) and losses[-1] == during["best_loss"]
    assert [(row[0], row[2]) for row in during["parameters"]] == [("angle", "deg"), ("level", "")]
    assert set(during["pictures"]) == {"target.png", "best.png"}
    after = RunFiles(tmp_path / "run").state()
    assert after["state"] == "finished" and after["evaluations"] == 40 and after["sentence"]
    assert after["best_loss"] <= during["best_loss"]
