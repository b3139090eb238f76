"""The line that says how far a run is: what it leaves out while nothing is known."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest

from fide_lab.run import Progress
from fide_plugins import fit
from fide_plugins.cli import progress
from fide_plugins.fitting.failures import FitError

NO_TIME = dict.fromkeys(("render", "encode", "train", "search"), 0.0)


@pytest.fixture(autouse=True)
def every_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "_EVERY", 0.0)


def last_line(capsys: pytest.CaptureFixture[str], *states: tuple[int, float], **facts: Any) -> str:
    """Last line of a run that had so many evaluations after so many seconds."""
    report = progress.lines("x")
    for done, seconds in states:
        known: dict[str, Any] = {"budget": 0, "best_loss": 0.5, "wall_s": seconds}
        report(Progress(done, **{**known, "times": NO_TIME, **facts}))
    return capsys.readouterr().err.splitlines()[-1]


def test_failed_renders_have_neither_loss_nor_shares(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the first image; and their time counts, so that no share is above 100 %."""

    def fails(x: np.ndarray) -> np.ndarray:
        calls.append(1)
        if not 7 < len(calls) <= 13:
            raise ValueError
        return np.full((8, 8), x[0])

    calls: list[int] = []
    monkeypatch.setattr("fide_plugins.fitting.fitting._SHOW_INTERVAL", 0.0)
    seen: list[Progress] = []
    show = progress.lines("x")

    def report(at: Progress) -> None:
        seen.append(at)
        show(at)

    with pytest.warns(RuntimeWarning, match="a render failed"), pytest.raises(FitError):
        fit(fails, np.zeros((8, 8)), 2, workers=0, seed=0, progress=report)
    lines = capsys.readouterr().err.splitlines()
    first = [line for line, at in zip(lines, seen, strict=True) if not at.evaluations]
    assert len(first) > 5 and not any("%" in line or "best" in line for line in first)
    assert first[-1] == "x  0/2000  0 rendering, 7 failed"
    assert all(sum(at.times.values()) <= at.wall_s for at in seen)
    assert np.all(np.diff([at.wall_s for at in seen]) > 0)
    shares = re.findall(r"(\d+)%", "".join(lines))
    assert shares and max(map(int, shares)) <= 100
    assert "inf" not in "".join(lines)


def test_a_log_gets_a_line_soon_and_then_one_a_minute(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()  # of the fixture above
    now = 1000.0
    monkeypatch.setattr("fide_plugins.cli.progress.time.monotonic", lambda: now)
    report = progress.lines("x")
    told = []
    for second in range(0, 601):
        now = 1000.0 + second
        report(Progress(second, 10_000, 0.5, float(second), NO_TIME))
        if capsys.readouterr().err:
            told.append(second)
    assert told == [5, *range(65, 601, 60)]
    report(Progress(10_000, 10_000, 0.5, 601.0, NO_TIME))
    assert "10000/10000" in capsys.readouterr().err  # the end is always told


def test_other_commands_write_into_a_log_as_seldom(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    assert progress.interval(5.0) == 60.0
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    assert progress.interval(5.0) == 5.0


def test_a_loss_that_is_infinite_is_not_shown(capsys: pytest.CaptureFixture[str]) -> None:
    line = last_line(capsys, (0, 0.0), (10, 1.0), best_loss=math.inf)
    assert "inf" not in line and "10 renders/s" in line


@pytest.mark.parametrize(
    ("done", "seconds", "text"),
    [(20, 1.0, "20 renders/s"), (2, 16.0, "8.0 s a render"), (3, 3.0, "1.0 renders/s"),
     (14, 10.0, "1.4 renders/s"), (99, 10.0, "9.9 renders/s"), (998, 100.0, "10 renders/s"),
     (300, 10.0, "30 renders/s")],
)  # fmt: skip
def test_slow_renderers_have_their_seconds(
    done: int, seconds: float, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert f"  {text}  " in last_line(capsys, (0, 0.0), (done, seconds))


def test_the_speed_of_a_resumed_run_is_that_of_this_call(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert "4.0 s a render" in last_line(capsys, (1000, 10.0), (1001, 14.0))


@pytest.mark.parametrize(
    ("limits", "left"),
    [
        ({"budget": 2000}, "about 4 h left"),  # 1990 renders of 8 s
        ({"budget": 110}, "about 13 min left"),
        ({"budget": 15}, "about 40 s left"),
        ({"time": 380.0}, "about 5 min left"),
        ({"budget": 2000, "time": 140.0}, "about 60 s left"),
        ({"budget": 15, "time": 1e6}, "about 40 s left"),
        ({}, None),
        ({"budget": 10}, None),  # it is over
        ({"time": 79.0}, None),
    ],
)
def test_the_time_that_is_left(
    limits: dict[str, float], left: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    """Until the first of budget and time limit; after a few renders only, which say how long."""
    line = last_line(capsys, (0, 0.0), (10, 80.0), **limits)
    assert (f"  8.0 s a render  {left}  " in line) if left else ("left" not in line)
    assert "left" not in last_line(capsys, (0, 0.0), (7, 56.0), **limits)
    assert "left" not in last_line(capsys, (0, 0.0), (10, 80.0), doing="first model", **limits)


def test_a_fit_tells_its_time_limit_and_where_its_speed_counts_from() -> None:
    seen: list[Progress] = []
    fit(lambda x: np.full((8, 8), x[0]), np.zeros((8, 8)), 2, 20, time=60, until="budget",
        workers=0, seed=0, progress=seen.append)  # fmt: skip
    assert seen[0].evaluations == 0 and seen[-1].evaluations == 20
    assert {at.time for at in seen} == {60.0}
