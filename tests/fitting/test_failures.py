"""Renders that fail, die or hang cost one candidate each; most failing ends the fit."""

from __future__ import annotations

import os
import pickle
import shlex
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import Float, Space, fit
from fide_plugins.errors import RenderError
from fide_plugins.fitting.failures import (
    CallbackError,
    EvaluationError,
    FitError,
    GivenUpError,
    RenderFailedWarning,
)
from fide_plugins.fitting.rendering import Rendered, Renderer
from fide_plugins.fitting.workers import OfExecutor
from fide_plugins.renderers import CommandRenderer

from .scene import SPACE, disk, target

GRAY = Space(gray=Float(0, 1))
WIDE: dict[str, Any] = {"seed": 0, "sigma0": 0.4}  # so that some candidates are unlucky


@pytest.mark.parametrize(
    ("misfortune", "message"),
    [
        ("raises", "ValueError: too far to the right"),
        ("wrong size", "must have the target's size, 16 x 16"),
        ("returns nothing", "render returned None; let it return its image"),
        ("nan", "must be finite"),
    ],
)
def test_a_failed_render_is_withdrawn_and_the_first_one_shown(
    misfortune: str, message: str
) -> None:
    with pytest.warns(RenderFailedWarning, match=message) as caught:
        result = fit(disk(misfortune), target(), SPACE, budget=80, workers=0, **WIDE)
    assert len(caught) == 1 and "render({'x': 0." in str(caught[0].message)
    assert result.failures > 1 and result.evaluations == 80
    assert result.first_failure is not None and result.first_failure.params["x"] > 0.9
    if misfortune == "raises":
        assert "raise ValueError" in result.first_failure.details
        assert "rendering.py" not in result.first_failure.details
    assert len(result.optimizer.state.population.pending) == 0


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("misfortune", "timeout", "message"),
    [
        ("dies", None, "its worker process died, killed by SIGKILL"),
        pytest.param(
            "dies while it sends",
            None,
            "its worker process died, killed by SIGKILL",
            marks=pytest.mark.timeout(100),
        ),
        ("hangs", 5, "longer than timeout=5 seconds"),  # so that on a busy machine no other one is
    ],
)
def test_a_killed_worker_and_a_hanging_render_cost_one_candidate(
    misfortune: str, timeout: float | None, message: str, tmp_path: Path
) -> None:
    render = disk(misfortune, log=tmp_path / "log")
    with pytest.warns(RenderFailedWarning, match=message):
        result = fit(render, target(), SPACE, budget=20, workers=2, timeout=timeout, seed=0)
    assert result.evaluations == 20 and result.failures == 1
    assert (tmp_path / "log").stat().st_size == 21
    assert len(result.optimizer.state.population.pending) == 0


def test_a_render_that_ends_the_program_is_a_failed_one() -> None:
    def render(params: dict[str, float]) -> Any:
        return sys.exit(0) if params["x"] > 0.9 else disk()(params)

    with pytest.warns(RenderFailedWarning, match="SystemExit: 0"):
        result = fit(render, target(), SPACE, budget=80, workers=0, **WIDE)
    assert result.evaluations == 80 and result.failures > 0


def test_bytes_of_a_thread_are_no_pickle(tmp_path: Path) -> None:
    """They may come from a server."""
    harm = tmp_path / "harm"
    answer = b"cos\nmkdir\n(V" + os.fsencode(harm) + b"\ntR."
    with pytest.warns(RenderFailedWarning), pytest.raises(GivenUpError):
        fit(lambda _: answer, target(), SPACE, executor="threads", workers=1, seed=0)
    assert not harm.exists()
    pickle.loads(answer)
    assert harm.exists()


def test_it_gives_up_when_the_first_ones_all_fail() -> None:
    def render(params: dict[str, float]) -> Any:
        raise OSError("no scene.pov")

    with pytest.warns(RenderFailedWarning), pytest.raises(GivenUpError) as caught:
        fit(render, target(), SPACE, workers=0, seed=0)
    assert isinstance(caught.value, RenderError) and isinstance(caught.value, FitError)
    text = str(caught.value)
    assert "the first 8 renders all failed; 8 failed so far" in text and "no scene.pov" in text
    assert caught.value.result.best is None and caught.value.result.failures == 8


HALF = "26 of the last 50 renders failed, more than max_failures=0.5"


@pytest.mark.parametrize(
    ("images", "options", "failed", "message"),
    [
        (30, {}, 50, "the last 50 renders all failed"),
        (6, {}, 50, "the last 50 renders all failed"),
        (30, {"max_failures": 0.5}, 26, HALF),
    ],
)
def test_it_gives_up_when_most_fail_and_keeps_what_it_has(
    images: int, options: dict[str, Any], failed: int, message: str
) -> None:
    count = iter(range(10**6))

    def render(params: dict[str, float]) -> Any:
        if next(count) >= images:
            raise MemoryError("full")
        return disk()(params)

    with pytest.warns(RenderFailedWarning), pytest.raises(GivenUpError) as caught:
        fit(render, target(), SPACE, workers=0, seed=0, **options)
    assert message in str(caught.value)
    result = caught.value.result
    assert (result.evaluations, result.failures) == (images, failed) and result.best is not None


def test_threads_that_hang_are_missed_and_when_all_do_it_gives_up() -> None:
    over = threading.Event()

    def render(params: dict[str, float]) -> Any:
        if params["x"] > 0.4:
            over.wait(60)
        return disk()(params)

    with ThreadPoolExecutor(2) as executor:
        arguments: dict[str, Any] = {"workers": 2, "executor": executor, "timeout": 0.1}
        with pytest.warns(RenderFailedWarning), pytest.raises(GivenUpError, match="2 workers hang"):
            fit(render, target(), SPACE, **arguments, **WIDE)
        over.set()


def test_a_killed_worker_leaves_no_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "files"))
    (tmp_path / "files").mkdir()
    log = tmp_path / "log"
    program = (
        "import os, sys, signal\n"
        "open(sys.argv[2], 'a').write(sys.argv[1] + '\\n')\n"
        "os.kill(os.getppid(), signal.SIGKILL)"
    )
    words = [sys.executable, "-I", "-S", "-c", program]
    render = CommandRenderer(f"{shlex.join(words)} {{out}} {shlex.quote(str(log))} {{gray}}", GRAY)
    with pytest.warns(RenderFailedWarning), pytest.raises(GivenUpError):
        fit(render, np.zeros((8, 8)), GRAY, workers=2, seed=0)
    written = [Path(line) for line in log.read_text().splitlines()]
    assert len(written) >= 8 and all(tmp_path / "files" in each.parents for each in written)
    assert not list((tmp_path / "files").iterdir())


def gated(gate: Path) -> Callable[[Any], Any]:
    """Function that waits until a file is there."""
    name = str(gate)

    def render(x: Any) -> Any:
        import os
        import time

        while not os.path.exists(name):
            time.sleep(0.01)
        return x

    return render


@pytest.mark.parametrize("pool", [ThreadPoolExecutor, ProcessPoolExecutor])
def test_waiting_in_the_queue_of_an_executor_is_no_time_of_a_render(
    pool: Any, tmp_path: Path
) -> None:
    context = {"mp_context": get_context("spawn")} if pool is ProcessPoolExecutor else {}
    with pool(1, **context) as executor:
        gate = tmp_path / "gate"
        workers = OfExecutor(executor, Renderer(gated(gate), None), 3)
        first, *_, last = [workers.submit(np.zeros(2)) for _ in range(3)]
        while (began := workers.began(first)) is None or not first.running():
            time.sleep(0.01)
        assert began <= time.monotonic()
        time.sleep(0.2)
        opened = time.monotonic()
        gate.touch()
        last.result(60)
        assert isinstance(workers.outcome(first), Rendered)
        late = workers.began(last)
        assert late is not None and late >= opened


def test_an_exception_of_a_callback_loses_nothing() -> None:
    def callback(event: Any) -> None:
        if event.evaluation == 9:
            raise KeyError("mine")

    with pytest.raises(
        CallbackError, match=r"failed in on_evaluation: KeyError\('mine'\)"
    ) as error:
        fit(disk(), target(), SPACE, workers=0, seed=0, callbacks=callback)
    assert isinstance(error.value.__cause__, KeyError)
    result = error.value.result
    assert result.evaluations == 10 and result.best is not None
    assert np.isfinite(result.best.loss)


@pytest.mark.parametrize("what", ["loss", "encoder"])
def test_an_exception_of_a_loss_or_an_encoder_loses_nothing(what: str, tmp_path: Path) -> None:
    calls, limit = 0, 40

    def loss(images: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls > limit:
            raise MemoryError("no more of it")
        return ((images - target()[..., None]) ** 2).mean(axis=(1, 2, 3))

    def encoder(images: Any) -> Any:
        loss(images)
        return images.reshape(len(images), 16, -1)

    options: dict[str, Any] = {what: loss if what == "loss" else encoder}
    options |= {"out": tmp_path, "workers": 0, "seed": 0, "budget": 60}
    with pytest.raises(EvaluationError, match=r"evaluating a render.*raised MemoryError") as error:
        fit(disk(), target(), SPACE, **options)
    assert isinstance(error.value.__cause__, MemoryError)
    result = error.value.result
    done = result.evaluations
    assert 20 < done < 40 and result.best is not None and result.failures == 0
    assert len((tmp_path / "curve.csv").read_text().splitlines()) == done + 1
    assert (tmp_path / "best.png").exists()
    limit = 1000
    resumed = fit(disk(), target(), SPACE, **options, resume=True)
    whole = fit(disk(), target(), SPACE, **{**options, "out": None})
    assert resumed.evaluations == 60
    np.testing.assert_array_equal(resumed.curve, whole.curve)
