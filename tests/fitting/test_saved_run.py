"""The run directory of a fit: going on gives the uninterrupted fit, whatever stopped it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fide_plugins import fit
from fide_plugins.errors import CheckpointError, FideError
from fide_plugins.fitting.fitting import FitInterrupted
from fide_plugins.fitting.result import Result
from fide_plugins.recording.storage import RunDirectoryError, read_checkpoint
from fide_plugins.types import Float32

from .scene import SPACE, disk, target


def same(one: Result, other: Result) -> bool:
    assert one.best is not None and other.best is not None
    return (
        np.array_equal(one.best.x, other.best.x)
        and np.array_equal(one.curve, other.curve)
        and one.best.evaluation == other.best.evaluation
        and str(one.status) == str(other.status)
    )


@pytest.fixture(scope="module")
def whole() -> Result:
    return fit(disk(), target(), SPACE, budget=60, workers=0, seed=5)


def test_a_larger_budget_goes_on_where_the_smaller_one_stopped(
    whole: Result, tmp_path: Path
) -> None:
    part = fit(disk(), target(), SPACE, budget=25, workers=0, seed=5, out=tmp_path)
    assert part.evaluations == 25 and part.out == tmp_path
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["state"] == "finished" and run["limits"] == {"budget": 25, "until": "solved"}
    assert run["totals"]["evaluations"] == 25 and run["settings"]["task"] == "render"
    assert run["settings"]["space"] == SPACE.to_dict() and "budget" not in run["settings"]
    for name in ("target.png", "best.png", "summary.png", "improvements.csv", "run.ckpt"):
        assert (tmp_path / name).stat().st_size > 0
    saved, _ = read_checkpoint(tmp_path)
    arguments: dict[str, Any] = {"workers": 0, "out": tmp_path, "resume": True}
    more = fit(disk(), target(), SPACE, budget=60, **arguments)  # the seed is the run's
    assert same(more, whole) and more.seconds > saved["wall_s"]
    rows = (tmp_path / "curve.csv").read_text().splitlines()[1:]
    assert [float(row.split(",")[2]) for row in rows] == whole.curve[:, 1].tolist()
    again = fit(disk(), target(), SPACE, budget=60, **arguments)
    assert same(again, whole)  # nothing was left to be done


def test_ctrl_c_saves_and_the_rest_is_that_of_the_uninterrupted_fit(
    whole: Result, tmp_path: Path
) -> None:
    count = iter(range(1, 1000))

    def render(params: dict[str, float]) -> Any:
        if next(count) == 40:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
        return disk()(params)

    arguments: dict[str, Any] = {"budget": 60, "workers": 0, "seed": 5, "out": tmp_path}
    with pytest.raises(FitInterrupted) as caught:
        fit(render, target(), SPACE, **arguments)
    assert isinstance(caught.value, KeyboardInterrupt) and caught.value.signum == signal.SIGINT
    assert caught.value.result.evaluations == 39
    assert json.loads((tmp_path / "run.json").read_text())["state"] == "interrupted"
    assert same(fit(render, target(), SPACE, resume=True, **arguments), whole)


def test_a_failed_fit_is_saved_too(whole: Result, tmp_path: Path) -> None:
    def callback(event: Any) -> None:
        if event.evaluation == 19:
            raise KeyError

    arguments: dict[str, Any] = {"budget": 60, "workers": 0, "seed": 5, "out": tmp_path}
    with pytest.raises(FideError):
        fit(disk(), target(), SPACE, callbacks=callback, **arguments)
    assert json.loads((tmp_path / "run.json").read_text())["state"] == "failed"
    assert same(fit(disk(), target(), SPACE, resume=True, **arguments), whole)


def means(size: int) -> Callable[[Float32], Any]:
    """An encoder: means of squares of so many pixels."""

    def encode(images: Float32) -> Any:
        n, height, width, _ = images.shape
        blocks = images.reshape(n, height // size, size, width // size, size, 3)
        return blocks.mean(axis=(2, 4)).reshape(n, -1, 3)

    return encode


def test_an_encoder_of_one_s_own_goes_on_and_another_is_refused(tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"workers": 0, "seed": 5}
    expected = fit(disk(), target(), SPACE, budget=40, encoder=means(4), **arguments)
    arguments["out"] = tmp_path
    fit(disk(), target(), SPACE, budget=20, encoder=means(4), **arguments)
    with pytest.raises(RunDirectoryError, match="other settings: features is"):
        fit(disk(), target(), SPACE, budget=40, encoder=means(2), resume=True, **arguments)
    again = fit(disk(), target(), SPACE, budget=40, encoder=means(4), resume=True, **arguments)
    assert same(again, expected)


def test_a_mask_is_the_same_in_any_form_and_another_is_refused(tmp_path: Path) -> None:
    pixels = np.zeros((16, 16), np.uint8)
    pixels[:, :8] = 255
    Image.fromarray(pixels).save(tmp_path / "mask.png")
    arguments: dict[str, Any] = {"workers": 0, "seed": 5, "out": tmp_path / "run"}
    fit(disk(), target(), SPACE, budget=10, mask=Image.fromarray(pixels), **arguments)
    arguments |= {"budget": 20, "resume": True}
    with pytest.raises(RunDirectoryError, match="settings: the mask or the weights differ"):
        fit(disk(), target(), SPACE, mask=Image.fromarray(255 - pixels), **arguments)
    assert fit(disk(), target(), SPACE, mask=tmp_path / "mask.png", **arguments).evaluations == 20
    Image.fromarray(255 - pixels).save(tmp_path / "mask.png")
    with pytest.raises(RunDirectoryError, match="settings: the mask or the weights differ"):
        fit(disk(), target(), SPACE, mask=tmp_path / "mask.png", **arguments)


def test_a_directory_of_another_run_is_refused(tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"workers": 0, "seed": 5, "out": tmp_path}
    fit(disk(), target(), SPACE, budget=10, **arguments)
    with pytest.raises(RunDirectoryError, match="already holds a run with these settings"):
        fit(disk(), target(), SPACE, budget=20, **arguments)
    with pytest.raises(RunDirectoryError, match="other settings: the target is"):
        fit(disk(), 1 - target(), SPACE, budget=20, resume=True, **arguments)
    with pytest.raises(RunDirectoryError, match="other settings: options is"):
        fit(disk(), target(), SPACE, budget=20, resume=True, popsize=12, **arguments)
    (tmp_path / "run.ckpt").write_bytes(b"nothing")
    with pytest.raises(CheckpointError):
        fit(disk(), target(), SPACE, budget=20, resume=True, **arguments)


SCRIPT = """
    import os, sys, time
    import numpy as np
    from fide_plugins import fit

    def render(x):
        with open(sys.argv[2], "a") as file:
            file.write(f"{os.getpid()}\\n")
        time.sleep(0.05)
        return np.full((8, 8), x.mean())

    fit(render, np.eye(8), 3, budget=None, time="1h", workers=2, seed=0,
        out=sys.argv[1], resume=True, progress=False)
"""


@pytest.mark.thorough
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize("signum", [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_with_their_parent_and_need_no_main_guard(
    signum: signal.Signals, tmp_path: Path, ends: Callable[[int], bool]
) -> None:
    script, log = tmp_path / "script.py", tmp_path / "pids"
    script.write_text(textwrap.dedent(SCRIPT))
    command = [sys.executable, str(script), str(tmp_path / "run"), str(log)]
    folder = tmp_path / "files"
    folder.mkdir()
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, env={**os.environ, "TMPDIR": str(folder)}
    )
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and process.poll() is None:
        if log.exists() and len(log.read_text().splitlines()) > 20:
            break
        time.sleep(0.1)
    assert len(list(folder.iterdir())) == 2, "a folder for each worker"
    process.send_signal(signum)
    _, errors = process.communicate(timeout=30)
    pids = {int(line) for line in log.read_text().splitlines()}
    assert len(pids) == 2 and process.pid not in pids, errors
    assert all(map(ends, pids)) and not list(folder.iterdir())
    if signum is signal.SIGTERM:
        assert "FitInterrupted: stopped by SIGTERM" in errors
        assert json.loads((tmp_path / "run" / "run.json").read_text())["state"] == "interrupted"
