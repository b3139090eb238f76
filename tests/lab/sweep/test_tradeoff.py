"""`fide tradeoff`: the combinations, the front, and the command as a user meets it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab.compare import RunKey, StoredRun
from fide_lab.compare.results import AXES, Curve
from fide_lab.sweep import Combination, configurations, front
from fide_plugins.cli import main
from fide_plugins.errors import OptionError

SMALL = ["--budget", "60", "--task-set", "cells=2", "--popsize", "6", "--seeds", "1"]


def fide(*words: object) -> int:
    return main([str(word) for word in words])


def made(name: str, seconds: list[float], losses: list[float], noise: float = 0.0) -> Combination:
    """Combination of one run that reached those losses after so many seconds, 10 renders each."""
    at = {"seconds": np.array(seconds), "renders": np.arange(1, len(seconds) + 1) * 10.0}
    ends = {axis: float(values[-1]) for axis, values in at.items()}
    totals = {"best_loss": losses[-1] - noise, "reference_loss": losses[-1]}
    run = StoredRun(
        RunKey("t", "mse", name, 0), Path(), "finished", "", {"totals": totals},
        Curve(at, ends, np.array(losses), {}),
    )  # fmt: skip
    return Combination("t", name, (run,))


QUICK = made("fide:quick", [1, 2, 3], [0.9, 0.5, 0.4])
SLOW = made("fide:slow", [10, 20, 30], [0.8, 0.3, 0.1])


def test_the_front_by_seconds_and_by_renders() -> None:
    """By seconds the quick one leads until the slow one passes it; by renders the slow one does."""
    by_time = front([QUICK, SLOW], "seconds")
    assert {p.combination for p in by_time if p.cost < 19} == {QUICK}
    assert {p.combination for p in by_time if p.cost > 20} == {SLOW}
    assert by_time[0].loss == 0.9 and by_time[-1].loss == 0.1
    losses = [p.loss for p in by_time]
    assert losses == sorted(losses, reverse=True) and len(set(losses)) == len(losses)
    assert {p.combination for p in front([QUICK, SLOW], "renders")} == {SLOW}


def test_options_with_a_colon_are_named_whole() -> None:
    one = made("fide:encoder=vgg19:relu4_1:popsize=9:preset=paper", [1], [0.5])
    assert one.label == "paper encoder=vgg19:relu4_1 popsize=9"


def test_a_run_of_noisy_images_counts_from_its_end_on() -> None:
    late = made("fide:late", [10, 20, 30], [0.8, 0.3, 0.1], noise=0.01)
    assert [(p.cost, p.loss) for p in front([late], "seconds")] == [(30, 0.1)]


def test_a_run_without_a_finite_loss_is_no_point_and_an_infinite_one_in_medians() -> None:
    none = Curve({axis: np.empty(0) for axis in AXES}, dict.fromkeys(AXES, 3.0), np.empty(0), {})
    totals = {"best_loss": None, "reference_loss": None}
    lost = replace(QUICK.runs[0], run={"totals": totals}, curve=none)
    assert not front([replace(QUICK, runs=(lost,))], "seconds")
    points = [
        (p.cost, p.loss) for p in front([replace(QUICK, runs=(*QUICK.runs * 2, lost))], "seconds")
    ]
    assert points == [(p.cost, p.loss) for p in front([QUICK], "seconds")]


def test_every_combination() -> None:
    options: dict[str, Any] = {"preset": ["balanced", "paper"], "popsize": [20, 40]}
    assert [configuration.label for configuration in configurations(options)] == [
        f"fide:popsize={k}:preset={preset}" for preset in ("balanced", "paper") for k in (20, 40)
    ]
    assert len(configurations({})) == 4
    wrong: dict[str, Any]
    for wrong in ({"preset": []}, {"popsize": [8, 8]}, {"preset": ["best"]}):
        with pytest.raises(OptionError):
            configurations(wrong)


@pytest.mark.figures
def test_the_command_runs_resumes_and_extends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "front"
    words = ["tradeoff", "voronoi", *SMALL, "--size", 16, "--out", out]
    assert fide(*words, "--preset", "fast,balanced") == 0
    assert "| fast popsize=6 " in capsys.readouterr().out
    names = {"tradeoff.md", "tradeoff-voronoi-seconds.png", "tradeoff-voronoi-renders.png"}
    assert names <= {path.name for path in out.iterdir()}
    assert fide(*words, "--preset", "fast") == 2
    assert "already holds a comparison" in capsys.readouterr().err
    assert fide(*words, "--preset", "fast,accurate", "--resume") == 0
    assert capsys.readouterr().err.count("/2]") == 1, "only what is missing"


@pytest.mark.parametrize(
    "wrong", [["--popsize", "3"], ["--preset", "best"], ["--budget", "0"], ["--size", "x"]]
)
def test_bad_words_are_one_line_and_run_nothing(
    wrong: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fide("tradeoff", "voronoi", "--preset", "fast", "--out", tmp_path / "o", *wrong) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "o").exists()
