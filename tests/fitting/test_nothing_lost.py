"""Full disks, a second Ctrl-C, missing files, two processes: what was computed is kept or told."""

from __future__ import annotations

import errno
import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import FIDE, fit
from fide_plugins.errors import CheckpointError
from fide_plugins.fitting.failures import RenderFailedWarning
from fide_plugins.fitting.fitting import FitInterrupted
from fide_plugins.fitting.one_call import prepare
from fide_plugins.fitting.result import Result
from fide_plugins.fitting.stopping import Stopping
from fide_plugins.fitting.workers import InThisProcess
from fide_plugins.recording.storage import RunDirectoryError, read_checkpoint
from fide_plugins.runtime import checkpoint, files

from .scene import SPACE, disk, target

ARGUMENTS: dict[str, Any] = {"budget": 60, "workers": 0, "seed": 5}


class Ends:
    """A callback that keeps what it is told at the end."""

    def __init__(self) -> None:
        self.results: list[Result] = []

    def on_end(self, result: Result) -> None:
        self.results.append(result)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def evaluations(folder: Path) -> int:
    return len((folder / "curve.csv").read_text().splitlines()) - 1


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture(scope="module")
def whole() -> Result:
    return fit(disk(), target(), SPACE, **ARGUMENTS)


# -- a disk that is full ---------------------------------------------------------------------------


def full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "cannot write it: no space; make room")


@pytest.mark.parametrize("all_files", [False, True])
def test_a_disk_without_room_at_the_end_leaves_the_result_to_the_error(
    all_files: bool, whole: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = Ends()

    def callback(event: Any) -> None:
        if event.evaluation == 59:
            monkeypatch.setattr(checkpoint, "write", full)
            if all_files:
                monkeypatch.setattr(files, "write_bytes", full)

    with pytest.raises(OSError, match="make room") as caught:
        prepare(
            disk(), target(), SPACE, stopping=Stopping(60), workers=0, seed=5, out=tmp_path,
            callbacks=[callback, ends], checkpoint_every=1e6,
        ).execute()  # fmt: skip
    assert any("attribute `result`" in note for note in caught.value.__notes__)
    result = caught.value.result  # type: ignore[attr-defined]
    assert ends.results == [result] and result.stopped == "budget"
    np.testing.assert_array_equal(result.curve, whole.curve)
    if not all_files:
        assert evaluations(tmp_path) == 60 and (tmp_path / "best.png").exists()
        run = json.loads((tmp_path / "run.json").read_text())
        assert run["state"] == "failed" and run["totals"]["evaluations"] == 60
        monkeypatch.undo()
        with pytest.warns(RuntimeWarning, match="the run begins again, and replaces them"):
            again = fit(disk(), target(), SPACE, **ARGUMENTS, out=tmp_path, resume=True)
        np.testing.assert_array_equal(again.curve, whole.curve)


def test_each_file_is_tried_where_another_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = files.write_bytes

    def no_table(path: Any, data: bytes) -> None:
        full() if Path(path).name == "curve.csv" else write(path, data)

    monkeypatch.setattr(files, "write_bytes", no_table)
    with pytest.raises(OSError, match="make room"):
        fit(disk(), target(), SPACE, **ARGUMENTS, out=tmp_path)
    assert {"best.png", "improvements.csv", "run.ckpt", "optimizer-60-0.ckpt"} <= {
        path.name for path in tmp_path.iterdir()
    }
    assert json.loads((tmp_path / "run.json").read_text())["state"] == "failed"
    monkeypatch.undo()
    again = fit(disk(), target(), SPACE, **ARGUMENTS, out=tmp_path, resume=True)
    assert again.evaluations == 60 and evaluations(tmp_path) == 60


@pytest.mark.parametrize("every", [0.0, 1e6], ids=["after a checkpoint", "before the first one"])
@pytest.mark.parametrize("kind", [MemoryError, KeyboardInterrupt, SystemExit])
def test_any_error_has_the_result_and_all_tables(
    kind: type[BaseException], every: float, tmp_path: Path, monkeypatch: Any
) -> None:
    ask, ends = FIDE.ask, Ends()

    def fails(self: FIDE, n: int | None = None) -> Any:
        if self.evaluations == 20:
            raise kind("of the optimizer")
        return ask(self, n)

    monkeypatch.setattr(FIDE, "ask", fails)
    with pytest.raises(kind, match="of the optimizer") as caught:
        prepare(
            disk(), target(), SPACE, stopping=Stopping(60), workers=0, seed=5, callbacks=ends,
            out=tmp_path, checkpoint_every=every,
        ).execute()  # fmt: skip
    result = caught.value.result  # type: ignore[attr-defined]
    assert result.evaluations == 20 and result.best is not None and ends.results == [result]
    assert not any("written" in note for note in caught.value.__notes__)
    assert len((tmp_path / "curve.csv").read_text().splitlines()) == 21
    last = (tmp_path / "improvements.csv").read_text().splitlines()[-1]
    assert last.split(",")[2] == repr(result.best.loss)


# -- a second signal -------------------------------------------------------------------------------


def signals_while(function: Any) -> Callable[..., Any]:
    """The function, with two signals while it runs."""

    def interrupted(*args: Any, **kwargs: Any) -> Any:
        interrupt()
        interrupt()
        return function(*args, **kwargs)

    return interrupted


@pytest.mark.parametrize("place", ["checkpoint", "tables", "workers", "on_end"])
def test_a_second_signal_stops_no_writing(
    place: str, whole: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count, ends = iter(range(1, 1000)), Ends()

    def render(params: dict[str, float]) -> Any:
        if next(count) == 40:
            owner, name = {
                "checkpoint": (checkpoint, "write"),
                "tables": (files, "write_bytes"),
                "workers": (InThisProcess, "close"),
                "on_end": (ends, "on_end"),
            }[place]
            monkeypatch.setattr(owner, name, signals_while(getattr(owner, name)))
            interrupt()
            time.sleep(10)
        return disk()(params)

    def tell(result: Result) -> None:
        ends.on_end(result)

    watcher: Any = type("Watcher", (), {"on_end": staticmethod(tell)})()
    with pytest.raises(FitInterrupted) as caught:
        fit(render, target(), SPACE, **ARGUMENTS, out=tmp_path, callbacks=watcher)
    assert caught.value.result.evaluations == 39 and evaluations(tmp_path) == 39
    assert json.loads((tmp_path / "run.json").read_text())["state"] == "interrupted"
    monkeypatch.undo()
    again = fit(render, target(), SPACE, **ARGUMENTS, out=tmp_path, resume=True)
    np.testing.assert_array_equal(again.curve, whole.curve)


# -- missing files ---------------------------------------------------------------------------------


def test_missing_files_of_a_run_are_named_and_its_results_stay(tmp_path: Path) -> None:
    fit(disk(), target(), SPACE, **ARGUMENTS, out=tmp_path)
    (tmp_path / "optimizer-mine.ckpt").write_bytes(b"a file of the user's")
    (tmp_path / "optimizer-60-0.ckpt").rename(tmp_path / "elsewhere")
    before = contents(tmp_path)
    arguments = {**ARGUMENTS, "budget": 80, "out": tmp_path, "resume": True}
    with pytest.raises(CheckpointError, match=r"optimizer-60-0\.ckpt: .* is missing; copy it back"):
        fit(disk(), target(), SPACE, **arguments)
    (tmp_path / "run.ckpt").rename(tmp_path / "somewhere")
    with pytest.raises(CheckpointError, match=r"results, but no run\.ckpt"):
        fit(disk(), target(), SPACE, **arguments)
    (tmp_path / "somewhere").rename(tmp_path / "run.ckpt")
    assert contents(tmp_path) == before
    (tmp_path / "elsewhere").rename(tmp_path / "optimizer-60-0.ckpt")
    assert fit(disk(), target(), SPACE, **arguments).evaluations == 80
    assert (tmp_path / "optimizer-mine.ckpt").exists()
    assert not (tmp_path / "optimizer-60-0.ckpt").exists()


def test_a_kill_between_the_two_files_of_a_checkpoint_after_a_failed_render(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As many are evaluated and pending as before it, but the optimizer has another state."""
    write = checkpoint.write

    def killed(path: Any, kind: str, state: dict[str, Any]) -> None:
        if kind == "run" and state["record"]["failures"]:
            raise OSError("killed")
        write(path, kind, state)

    def start(out: Path | None) -> Result:
        return prepare(
            disk("raises"), target(), SPACE, stopping=Stopping(60), workers=0, seed=0, out=out,
            resume=out is not None, options={"sigma0": 0.4}, checkpoint_every=0,
        ).execute()  # fmt: skip

    with monkeypatch.context() as patch, pytest.warns(RenderFailedWarning):
        patch.setattr(checkpoint, "write", killed)
        with pytest.raises(OSError, match="killed"):
            start(tmp_path)
    with pytest.warns(RenderFailedWarning):
        resumed, expected = start(tmp_path), start(None)
    assert resumed.failures == expected.failures
    np.testing.assert_array_equal(resumed.curve, expected.curve)


@pytest.mark.skipif(os.name == "nt", reason="no such locks on Windows")
def test_a_directory_is_locked_while_a_fit_runs_and_may_be_read(tmp_path: Path) -> None:
    seen = []

    def callback(event: Any) -> None:
        if event.evaluation == 30:
            with pytest.raises(RunDirectoryError, match="another process"):
                fit(disk(), target(), SPACE, **ARGUMENTS, out=tmp_path, resume=True)
            seen.append(read_checkpoint(tmp_path)[1])

    fit(disk(), target(), SPACE, **{**ARGUMENTS, "budget": 10}, out=tmp_path)
    fit(disk(), target(), SPACE, **ARGUMENTS, out=tmp_path, resume=True, callbacks=callback)
    assert seen == ["optimizer-10-0.ckpt"]
    (tmp_path / "run.ckpt").write_bytes(b"nothing")
    with pytest.raises(CheckpointError) as kept:  # with all that its traceback refers to
        fit(disk(), target(), SPACE, **ARGUMENTS, out=tmp_path, resume=True)
    with pytest.raises(CheckpointError):
        fit(disk(), target(), SPACE, **ARGUMENTS, out=tmp_path, resume=True)
    assert kept.value is not None


# -- the same options ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "forms"),
    [
        ("x0", [np.array([0.1, 0.2, 0.3, 0.4]), [0.1, 0.2, 0.3, 0.4], (0.1, 0.2, 0.3, 0.4)]),
        ("sigma0", [np.array([0.1, 0.2, 0.1, 0.2]), [0.1, 0.2, 0.1, 0.2]]),
        ("sigma0", [np.float64(0.2), 0.2, np.array(0.2)]),
        ("groups", [[[0, 2], [1, 3]], np.array([[0, 2], [1, 3]]), ((0, 2), (1, 3))]),
    ],
)
def test_an_option_is_the_same_in_any_form(name: str, forms: list[Any], tmp_path: Path) -> None:
    for k, form in enumerate(forms):
        arguments: dict[str, Any] = {"workers": 0, "seed": 5, "out": tmp_path, name: form}
        fit(disk(), target(), SPACE, budget=10 + k, resume=k > 0, **arguments)
    arguments[name] = {"x0": [0.4] * 4, "sigma0": 0.3, "groups": [[0, 1], [2, 3]]}[name]
    with pytest.raises(RunDirectoryError, match="other settings: options is"):
        fit(disk(), target(), SPACE, budget=20, resume=True, **arguments)
