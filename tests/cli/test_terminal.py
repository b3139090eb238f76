"""The terminal: streams that are closed or full, flags that are not known, texts, progress."""

from __future__ import annotations

import argparse
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab.run import Progress
from fide_plugins import fit
from fide_plugins.cli import main, progress, suggestion
from fide_plugins.cli.terminal import standard_streams
from fide_plugins.fitting.failures import FitError
from fide_plugins.runtime.messages import counted

from .conftest import fide, one_line

FULL = Path("/dev/full")
full = pytest.mark.skipif(not FULL.exists(), reason="no device that is always full")


def in_shell(code: str, redirected: str) -> subprocess.CompletedProcess[str]:
    """Python code in a process of the shell, with its streams redirected."""
    command = f'exec "$0" -c "$1" {redirected}'
    return subprocess.run(
        ["sh", "-c", command, sys.executable, code], capture_output=True, text=True, timeout=60
    )


@full
@pytest.mark.parametrize("words", ["--version", "fit --help"])
def test_output_on_a_full_disk_is_one_line_and_an_exit_code(words: str) -> None:
    code = f"import sys; from fide_plugins.cli import main; sys.exit(main({words.split()}))"
    done = in_shell(code, ">/dev/full")
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        "fide: cannot write to standard output: No space left on device"
    ]
    assert in_shell(code, ">/dev/full 2>&1").returncode == 1


@full
def test_messages_on_a_full_disk_are_lost_and_end_nothing() -> None:
    code = "from fide_plugins.cli.terminal import note; note('no'); note('no'); print('done')"
    done = in_shell(code, "2>/dev/full")
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\n", "")


def test_no_file_takes_the_place_of_a_closed_stream(tmp_path: Path) -> None:
    """Else messages would be written into it, and what a child of this process prints."""
    code = f"""
import os, subprocess, sys
from fide_plugins.cli.terminal import standard_streams
with standard_streams():
    file = os.open({str(tmp_path / "file")!r}, os.O_CREAT | os.O_WRONLY)
    print("message", file=sys.stderr, flush=True)
    print("result", flush=True)
    subprocess.run(["sh", "-c", "echo message; echo message >&2"], check=True)
    sys.exit(file)
"""
    assert in_shell(code, "<&- >&- 2>&-").returncode > 2
    assert (tmp_path / "file").read_bytes() == b""


def test_a_fit_without_standard_streams(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Python starts where they are closed."""
    monkeypatch.chdir(tmp_path)
    Path("scene.py").write_text(
        "import numpy as np\ndef render(p):\n    return np.full((4, 4, 3), p['gray'])\n"
    )
    Path("space.toml").write_text('[gray]\ntype = "float"\nlow = 0\nhigh = 1\n')
    from PIL import Image

    Image.new("RGB", (4, 4), (90, 90, 90)).save("t.png")
    for name in ("stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    words = "fit t.png --renderer scene.py:render --space space.toml --budget 9 --workers 0"
    assert main([*words.split(), "--out", "o"]) == 0
    assert Path("o", "run.ckpt").exists()
    assert sys.stdin is sys.stdout is sys.stderr is None


def test_streams_are_given_back() -> None:
    before = sys.stdin, sys.stdout, sys.stderr
    with standard_streams():
        assert sys.stdout is not before[1] and sys.stdout.fileno
    assert (sys.stdin, sys.stdout, sys.stderr) == before


# -- what is told of a flag, a command or a name that is not known ---------------------------------


FIT = ("fit", "target.png", "--renderer", "scene.py:render")


@pytest.mark.parametrize(
    ("words", "end"),
    [
        ((*FIT, "--budgt", 10), "did you mean --budget?"),
        ((*FIT, "--worker=2"), "did you mean --workers?"),
        ((*FIT, "--budget", 3, "--losss", "mse"), "did you mean --loss?"),
        (("run", "voronoi", "--bugdet", 5), "did you mean --budget?"),
        (("run", "voronoi", "--until"), "--until is of fide fit"),
        (
            ("solutions", "out", "--task-seed", 3),
            "--task-seed is of fide run and fide compare and fide tradeoff",
        ),
        (
            ("check", "scene.py:render", "--budget", 3),
            "--budget is of fide fit and fide run and fide compare",
        ),
        (("rn", "voronoi"), "did you mean 'run'?"),
        (("list", "task"), "did you mean 'tasks'?"),
        (("fit", "target.png", "--model", "voronoii"), "did you mean 'voronoi'?"),
    ],
)
def test_the_flag_or_the_word_that_was_meant(
    words: tuple[object, ...], end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fide(*words) == 2
    assert one_line(capsys).rpartition("; see fide")[0].endswith(f"; {end}")


def test_other_commands_are_looked_into_only_if_no_flag_is_close() -> None:
    def others() -> dict[str, argparse.ArgumentParser]:
        asked.append(1)
        return {"run": of_another}

    own, of_another = (argparse.ArgumentParser(add_help=False) for _ in range(2))
    own.add_argument("--budget")
    of_another.add_argument("--replicas")
    asked: list[int] = []
    unknown = "unrecognized arguments: "
    assert suggestion(f"{unknown}--budgt 3", own, others) == "; did you mean --budget?"
    assert not asked
    assert suggestion(f"{unknown}--replicas", own, others) == "; --replicas is of fide run"


@pytest.mark.parametrize("words", [(*FIT, "--xyzzy"), (*FIT, "extra"), ("xyzzy",)])
def test_nothing_is_suggested_that_is_not_close(
    words: tuple[object, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert fide(*words) == 2
    assert "did you mean" not in one_line(capsys)


@pytest.mark.parametrize(
    ("words", "end"),
    [
        (("run", "voronio"), "did you mean 'voronoi'?"),
        (("run", "voronoi", "--task-set", "cell=4"), "did you mean 'cells'?"),
    ],
)
def test_tasks_and_their_options(
    words: tuple[object, ...], end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fide(*words) == 2
    assert one_line(capsys).rstrip().endswith(end)


@pytest.mark.parametrize(
    ("given", "instead"),
    [
        ((*FIT, "--optimizer", "cma"), "fide run scene.py:render --target target.png"),
        (
            ("fit", "target.png", "--command", "ls {out}", "--space", "s.toml"),
            "fide run --command 'ls {out}' --space s.toml --target target.png",
        ),
    ],
)
def test_another_optimizer_is_of_another_command(
    given: tuple[object, ...], instead: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert fide(*given, *([] if "--optimizer" in given else ["--optimizer", "cma"])) == 2
    assert one_line(capsys).rstrip().endswith(f"another one: {instead} --optimizer cma")


@pytest.mark.usefixtures("target")
def test_the_command_that_is_named_does_it(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "scene.py:render", "--target", "target.png", "--optimizer", "random"]
    assert fide(*words, "--budget", 3, "--out", "out") == 0
    assert "after 3 renders" in capsys.readouterr().out


def test_an_option_that_has_taken_the_target_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert fide("fit", "--value-range", 0, 10, "t.tif", "--renderer", "s.py:f") == 2
    assert "--value-range has taken 't.tif': write --value-range=0,10" in one_line(capsys)


# -- texts of commands -----------------------------------------------------------------------------


def test_one_thread_is_one_thread() -> None:
    assert [counted(n, "thread") for n in (0, 1, 2)] == ["0 threads", "1 thread", "2 threads"]


def test_fit_names_the_defaults_of_budget_and_loss(capsys: pytest.CaptureFixture[str]) -> None:
    assert fide("fit", "--help") == 0
    letters = "".join(capsys.readouterr().out.split())  # lines break at hyphens, too
    assert "numberofrenders(2000;with--model5000;with--timeor--untilstalled:any)" in letters
    assert "see:fidelistlosses(mse)" in letters


# -- the line that says how far a run is -----------------------------------------------------------


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


def test_a_fit_tells_its_time_limit_and_where_its_speed_counts_from() -> None:
    seen: list[Progress] = []
    fit(lambda x: np.full((8, 8), x[0]), np.zeros((8, 8)), 2, 20, time=60, until="budget",
        workers=0, seed=0, progress=seen.append)  # fmt: skip
    assert seen[0].evaluations == 0 and seen[-1].evaluations == 20
    assert {at.time for at in seen} == {60.0}
