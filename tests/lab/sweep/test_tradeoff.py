"""`fide tradeoff`: the grid, the front, and the command as a user meets it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fide_tasks
from fide_lab.compare import RunKey, StoredRun
from fide_lab.compare.results import Curve
from fide_lab.sweep import AXES, Combination, Grid, best_within, front, read
from fide_plugins.cli import main
from fide_plugins.errors import OptionError

SMALL = ["--budget", "60", "--task-set", "cells=2", "--popsize", "6"]


def fide(*words: object) -> int:
    return main([str(word) for word in words])


def made(name: str, seconds: list[float], losses: list[float], **more: Any) -> Combination:
    """Combination of one run that reached those losses after so many seconds, 10 renders each."""
    at = {"seconds": np.array(seconds), "renders": np.arange(1, len(seconds) + 1) * 10.0}
    ends = {axis: float(values[-1]) for axis, values in at.items()}
    curve = Curve(at, ends, np.array(losses), {})
    run = StoredRun(RunKey("t", "mse", name, 0), Path(), "finished", "", {}, curve)
    return Combination("t", name, 16, None, (run,), (losses[-1],), **({"anytime": True} | more))


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


@pytest.mark.parametrize(
    ("seconds", "best", "loss"),
    [(0.5, None, None), (1, QUICK, 0.9), (15, QUICK, 0.4), (20, SLOW, 0.3), (3600, SLOW, 0.1)],
)
def test_what_is_best_within_a_time(
    seconds: float, best: Combination | None, loss: float | None
) -> None:
    point = best_within([QUICK, SLOW], "seconds", seconds)
    assert (best, loss) == (None, None) if point is None else (point.combination, point.loss) == (
        best, loss
    )  # fmt: skip


def test_options_with_a_colon_are_named_whole() -> None:
    one = made("fide:encoder=vgg19:relu4_1:popsize=9:preset=paper", [1], [0.5])
    assert one.words == ("paper", "encoder=vgg19:relu4_1", "popsize=9", "size=16")


def test_of_equals_the_cheapest() -> None:
    twin = made("fide:twin", [1, 2, 2.5], [0.9, 0.5, 0.4])
    point = best_within([QUICK, twin], "seconds", 60)
    assert point is not None and point.combination is twin


def test_where_images_differ_a_run_counts_from_its_end_on() -> None:
    late = made("fide:late", [10, 20, 30], [0.8, 0.3, 0.1], anytime=False)
    assert best_within([late], "seconds", 29.9) is None
    assert [(p.cost, p.loss) for p in front([late], "seconds")] == [(30, 0.1)]


def test_a_run_without_a_finite_loss_is_no_point_and_an_infinite_one_in_medians() -> None:
    none = Curve({axis: np.empty(0) for axis in AXES}, dict.fromkeys(AXES, 3.0), np.empty(0), {})
    lost = replace(QUICK.runs[0], curve=none)
    assert not front([replace(QUICK, runs=(lost,), finals=(np.inf,))], "seconds")
    two_of_three = replace(QUICK, runs=(*QUICK.runs * 2, lost), finals=(0.4, 0.4, np.inf))
    points = [(p.cost, p.loss) for p in front([two_of_three], "seconds")]
    assert points == [(p.cost, p.loss) for p in front([QUICK], "seconds")]


def test_the_grid_is_every_combination_and_leaves_the_network_to_those_that_have_one() -> None:
    options: dict[str, Any] = {
        "preset": ["balanced", "paper"],
        "popsize": [20, 40],
        "epochs": [1, 2],
        "size": [8, 9],
    }
    grid = Grid(("voronoi",), {**options, "spp": [4]})
    assert [configuration.label for configuration in grid.configurations()] == [
        "fide:popsize=20:preset=balanced",
        "fide:popsize=40:preset=balanced",
        *(f"fide:epochs={e}:popsize={k}:preset=paper" for k in (20, 40) for e in (1, 2)),
    ]
    plans = dict(grid.plans())
    assert list(plans) == ["size-8-spp-4", "size-9-spp-4"]
    assert plans["size-9-spp-4"].size == 9
    assert plans["size-9-spp-4"].task_options == {"spp": 4}


@pytest.mark.parametrize(
    "options", [{"colour": [1]}, {"preset": []}, {"size": [8, 8]}, {"preset": ["best"]}]
)
def test_a_grid_that_makes_no_sense(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError):
        Grid(("voronoi",), options)


@pytest.mark.figures
def test_the_command_runs_resumes_and_extends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "front"
    words = ["tradeoff", "voronoi", *SMALL, "--seeds", 1, "--size", 16, "--out", out]
    assert fide(*words, "--preset", "fast,balanced", "--json") == 0
    captured = capsys.readouterr()
    advice = json.loads(captured.out.splitlines()[-1])["voronoi"]
    assert set(advice) == {"1 minute", "10 minutes", "an hour"}
    combinations = read(out)
    best = min(combinations, key=lambda s: s.final)
    assert advice["an hour"]["loss"] == best.final
    assert "which ended after" in captured.err
    assert "one seed decides nothing" in captured.err
    assert "| popsize=6 size=16 | runs |" in captured.err and "\n| fast | 1 |" in captured.err
    names = {"tradeoff.md", "tradeoff.csv", "size-16"}
    names |= {
        f"tradeoff-voronoi-{a}.{kind}" for a in ("seconds", "renders") for kind in ("svg", "png")
    }
    assert {path.name for path in out.iterdir()} == names

    assert fide(*words, "--preset", "fast") == 2
    assert "already holds a comparison" in capsys.readouterr().err
    before = (
        out / "size-16/cells/voronoi/mse/fide+popsize=6+preset=fast/seed-0/run.json"
    ).read_bytes()
    more = [8 if word == 16 else word for word in words]
    assert fide(*more, "--preset", "fast", "--resume") == 0
    captured = capsys.readouterr()
    assert captured.err.count("[1/1]") == 1
    assert {(s.size, s.anytime) for s in read(out)} == {(16, False), (8, False)}
    after = (
        out / "size-16/cells/voronoi/mse/fide+popsize=6+preset=fast/seed-0/run.json"
    ).read_bytes()
    assert after == before


@pytest.mark.parametrize(
    "wrong", [["--popsize", "3"], ["--preset", "best"], ["--epochs", "x"], ["--spp", "4"],
              ["--budget", "0"], ["--epochs", "2"]]
)  # fmt: skip
def test_bad_words_are_one_line_and_run_nothing(
    wrong: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["tradeoff", "voronoi", "--size", 16, "--preset", "fast", "--out", tmp_path / "o"]
    assert fide(*words, *wrong) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("more", "said"),
    [(["--loss", "loi"], "loss is 'mse' there and 'loi' here"),
     (["--task-seed", 3], "task seed is 0 there and 3 here"),
     (["--budget", 30], "budget is 60 there and 30 here"),
     (["--task-set", "cells=3"], "task options is {'cells': 2} there and {'cells': 3} here")],
)  # fmt: skip
def test_a_sweep_is_extended_by_what_can_be_compared(
    more: list[Any], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also with other sizes, whose comparison would be a new one."""
    words = ["tradeoff", "voronoi", *SMALL, "--seeds", 1, "--preset", "fast", "--out", tmp_path]
    assert fide(*words, "--size", 8) == 0
    before = sorted(tmp_path.iterdir())
    capsys.readouterr()
    assert fide(*words, "--size", 12, "--resume", *more) == 2
    assert said in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def test_runs_of_noisy_images_count_from_their_end_on(tmp_path: Path) -> None:
    """Low losses under way may be luck: what was found is judged without noise."""
    pytest.importorskip("mitsuba")
    words = ["tradeoff", "beads", "--seeds", 1, "--preset", "fast", "--popsize", 5, "--size", 8,
             "--budget", 10, "--spp", 1, "--task-set", "reference_spp=16"]  # fmt: skip
    assert fide(*words, "--out", tmp_path) == 0
    (combination,) = read(tmp_path)
    (run,) = combination.runs
    assert not combination.anytime and run.totals["best_loss"] != combination.final
    assert [(p.cost, p.loss) for p in combination.points("renders")] == [(10.0, combination.final)]


def test_where_only_ends_count_a_setting_is_one_point() -> None:
    """At the median of its ends, with the median of what was found, whichever run was slower."""
    runs = [made("fide:a", [1, end], [0.9, 0.5]).runs[0] for end in (2, 3, 4)]
    combination = Combination("t", "fide:a", 16, 1, tuple(runs), (0.5, 0.3, 0.4), anytime=False)
    assert [(p.cost, p.loss) for p in combination.points("seconds")] == [(3.0, 0.4)]


def test_where_sizes_differ_all_are_judged_by_the_largest(tmp_path: Path) -> None:
    words = ["tradeoff", "voronoi", *SMALL, "--seeds", 1, "--preset", "fast", "--size", "8,16"]
    assert fide(*words, "--out", tmp_path) == 0
    task = fide_tasks.make("voronoi", 16, 0, cells=2)
    for combination in read(tmp_path):
        x = np.array(combination.runs[0].totals["x_best"])
        image = task.render(x[None])[0]
        expected = float(np.square(np.float64(image) - task.target).mean())
        assert combination.final == pytest.approx(expected, rel=1e-6)


def test_a_renderer_of_one_s_own_has_no_size_to_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.py").write_text(
        "import numpy as np\nspace = 2\ndef render(x): return np.full((8, 8), x.mean())\n"
    )
    words = ["tradeoff", "scene.py:render", "--seeds", 1, "--preset", "fast", "--out", "out"]
    words += ["--budget", 20, "--popsize", 6]
    assert fide(*words, "--size", "16") == fide(*words, "--size", "16,32") == 2
    assert capsys.readouterr().err.count("scene.py:render is a renderer of your own") == 2
    assert not Path("out").exists()
    assert fide(*words) == 0
    assert " size=" not in capsys.readouterr().out
    (combination,) = read(Path("out"))
    assert combination.words == ("fast", "popsize=6")
    Grid(("voronoi", "scene.py:render"), {"size": [16]})
    with pytest.raises(OptionError, match="has its own size"):
        Grid(("voronoi", "scene.py:render"), {"size": [16, 32]})
