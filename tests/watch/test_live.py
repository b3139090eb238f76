"""What a fit and a run write, as the page reads it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

import fide_plugins
from fide_plugins import Float, Space
from fide_plugins.cli import main
from fide_plugins.types import Float32
from fide_plugins.watch import LiveFile
from fide_plugins.watch.snapshot import RunFiles

SPACE = Space(angle=Float(-60, 60, unit="deg"), level=Float(0, 1))


def render(params: dict[str, Any]) -> Float32:
    image = np.full((8, 8, 3), params["level"], np.float32)
    image[:, :4] *= (params["angle"] + 60) / 120
    return image


def test_a_fit_is_shown_while_it_goes_on(tmp_path: Path) -> None:
    target = render({"angle": 30.0, "level": 0.8})
    seen: list[dict[str, Any]] = []

    def look(event: Any) -> None:
        if event.evaluation == 25:
            seen.append(RunFiles(tmp_path / "run").state())

    fide_plugins.fit(
        render,
        target,
        SPACE,
        budget=40,
        until="budget",
        workers=0,
        seed=0,
        out=tmp_path / "run",
        callbacks=[LiveFile(every=0.0), look],
    )
    (during,) = seen
    assert during["state"] == "running"
    assert during["evaluations"] == 26 and during["budget"] == 40
    losses = [loss for _, loss in during["improvements"]]
    assert losses == sorted(losses, reverse=True) and losses[-1] == during["best_loss"]
    assert [(row[0], row[2]) for row in during["parameters"]] == [("angle", "deg"), ("level", "")]
    assert set(during["pictures"]) == {"target.png", "best.png"}
    after = RunFiles(tmp_path / "run").state()
    assert after["state"] == "finished" and after["evaluations"] == 40 and "busy" not in after
    assert after["best_loss"] <= during["best_loss"]


def test_a_call_without_a_page_shows_nothing_of_an_earlier_one(tmp_path: Path) -> None:
    out = tmp_path / "run"
    arguments: dict[str, Any] = {"workers": 0, "seed": 0, "out": out, "until": "budget"}
    target = render({"angle": 30.0, "level": 0.8})
    fide_plugins.fit(render, target, SPACE, 20, callbacks=[LiveFile()], **arguments)
    assert (out / "live.json").exists()
    fide_plugins.fit(render, target, SPACE, 40, resume=True, **arguments)
    state = RunFiles(out).state()
    assert not (out / "live.json").exists() and state["evaluations"] == 40
    assert not {"budget", "workers"} & state.keys()


def test_it_writes_no_more_often_than_it_says(tmp_path: Path) -> None:
    now = [0.0]
    live, written = LiveFile(every=0.5, clock=lambda: now[0]), []

    def look(event: Any) -> None:
        written.append(json.loads((tmp_path / "run/live.json").read_text())["evaluations"])
        now[0] += 0.2

    fide_plugins.fit(
        render, render({"angle": 0.0, "level": 0.5}), SPACE,
        budget=9, workers=0, seed=0, out=tmp_path / "run", callbacks=[live, look],
    )  # fmt: skip
    assert written == [1, 1, 1, 4, 4, 4, 7, 7, 7]
    end = json.loads((tmp_path / "run/live.json").read_text())
    assert end["evaluations"] == 9 and end["busy"] == 0
    rows = (tmp_path / "run/curve.csv").read_text().splitlines()
    assert end["best_loss"] == float(rows[-1].split(",")[2])


def test_a_run_of_the_command_line_is_shown(tmp_path: Path) -> None:
    words = ["run", "voronoi", "--size", "16", "--budget", "40", "--out", str(tmp_path / "run")]
    assert main([*words, "--set", "popsize=6"]) == 0
    state = RunFiles(tmp_path / "run").state()
    assert state["state"] == "finished" and state["evaluations"] == 40
    assert set(state["pictures"]) == {"target.png", "best.png"}
    assert state["improvements"][-1][1] == state["best_loss"]
