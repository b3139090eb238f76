"""`fit` is ask and tell by hand, stops by its rules, and says what it has found."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import FIDE, fit
from fide_plugins.errors import FideError, OptionError
from fide_plugins.fitting.callbacks import Event, StopFitting
from fide_plugins.fitting.one_call import prepare
from fide_plugins.fitting.stopping import Stopping
from fide_plugins.types import Float64

from .scene import ANSWER, SPACE, disk, target


def by_hand(budget: int, seed: int) -> FIDE:
    opt, render = FIDE(SPACE, target(), seed=seed), disk()
    for _ in range(budget):
        X = opt.ask(1)
        opt.tell(X, [render(SPACE.decode(X[0]))])
    return opt


@pytest.mark.parametrize("workers", [0, 1])
def test_one_worker_is_ask_and_tell_by_hand(workers: int) -> None:
    seen: list[Event] = []
    result = fit(disk(), target(), SPACE, 70, workers=workers, seed=3, callbacks=seen.append)
    opt = by_hand(70, 3)
    assert opt.best is not None and result.best is not None
    assert np.array_equal(result.best.x, opt.best.x) and result.best.loss == opt.best.loss
    assert result.params == result.best.params == opt.best.params
    assert result.evaluations == len(seen) == 70
    losses = [event.loss for event in seen]
    assert np.array_equal(result.curve[:, 0], np.arange(1, 71))
    assert np.array_equal(result.curve[:, 1], np.minimum.accumulate(losses))
    assert [one.loss for one in result.solutions] == [one.loss for one in opt.solutions()]
    assert result.status == opt.status and result.stopped == "budget"


def test_further_views_are_a_list_of_pictures() -> None:
    def both(params: dict[str, float]) -> list[Any]:
        return [disk()(params)] * 2

    apart = fit(both, target(), SPACE, 20, views=[target()], workers=0, seed=0)
    together = fit(both, [target(), target()], SPACE, 20, workers=0, seed=0)
    assert np.array_equal(apart.curve, together.curve)
    with pytest.raises(OptionError, match="views must be a list of pictures .* not 2; write"):
        fit(both, target(), SPACE, 20, views=2, workers=0)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="pictures beside one target"):
        fit(both, [target(), target()], SPACE, 20, views=["front", "side"], workers=0)


def unasked(budget: int) -> Callable[[], object]:
    """A fit, ready to start, whose optimizer and renderer do nothing."""
    image, X, losses = target(), np.full((1, 4), 0.5), np.array([0.5])
    stopping = Stopping.of(budget, None, None)
    fitting = prepare(lambda x: image, image, 4, stopping=stopping, workers=0, seed=0)
    optimizer: Any = fitting.optimizer
    optimizer.ask, optimizer.tell = lambda n: X, lambda X, images: losses
    return fitting.execute


def test_the_loop_makes_few_calls_for_a_render(
    counted_calls: Callable[[Counter[str]], AbstractContextManager[None]],
) -> None:
    """Calls are counted, which no other program can change; those of begin and end are left out."""

    def calls(budget: int) -> int:
        execute, count = unasked(budget), Counter[str]()
        with counted_calls(count):
            execute()
        return count["calls"]

    calls(100)  # what is done once in a process
    assert (calls(1500) - calls(500)) / 1000 < 215  # 179 in November 2026


def test_several_workers_find_the_disk_too() -> None:
    result = fit(disk(), target(), SPACE, budget=250, executor="threads", workers=4, seed=0)
    assert result.evaluations == 250 and result.failures == 0
    assert result.params == pytest.approx(ANSWER, abs=0.1)


def test_threads_stay_for_all_renders_of_a_fit() -> None:
    threads: list[int] = []

    def render(params: dict[str, float]) -> Any:
        threads.append(threading.get_ident())
        time.sleep(0.001)
        return disk()(params)

    fit(render, target(), SPACE, budget=30, executor="threads", workers=2, seed=0)
    assert len(set(threads)) <= 2 and len(threads) >= 30


def test_a_user_s_executor_is_used_and_left_open() -> None:
    with ThreadPoolExecutor(2, thread_name_prefix="mine") as executor:
        names: list[str] = []

        def render(x: Float64) -> Any:
            names.append(threading.current_thread().name)
            assert x.shape == (4,)
            return disk()(SPACE.decode(x))

        result = fit(render, target(), 4, budget=30, executor=executor, workers=2, seed=0)
        assert result.evaluations == 30 and isinstance(result.params, np.ndarray)
        assert all(name.startswith("mine") for name in names)
        assert executor.submit(int, "7").result() == 7


def test_what_cannot_be_sent_to_processes_runs_in_threads() -> None:
    import threading

    lock, inner = threading.Lock(), disk()

    def render(params: dict[str, float]) -> Any:
        with lock:
            return inner(params)

    with pytest.warns(RuntimeWarning, match="cannot pickle '_thread.lock' object.*threads"):
        result = fit(render, target(), SPACE, budget=10, workers=2, seed=0)
    assert result.evaluations == 10
    with pytest.raises(OptionError, match="cannot be sent to other processes"):
        fit(render, target(), SPACE, budget=10, executor="processes")


# -- stopping --------------------------------------------------------------------------------------


def test_it_stops_at_a_loss_and_by_time_and_when_told() -> None:
    arguments: dict[str, Any] = {"workers": 0, "seed": 0}
    reached = fit(disk(), target(), SPACE, stop_at=0.01, **arguments)
    assert reached.stopped == "stop_at" and reached.evaluations < 2000
    assert reached.curve[-1, 1] <= 0.01 < reached.curve[-2, 1]
    soon = fit(disk(), target(), SPACE, None, time=0.2, **arguments)
    assert soon.stopped == "time" and soon.seconds >= 0.2
    told = fit(disk(), target(), SPACE, callbacks=lambda e: e.evaluation == 4, **arguments)
    assert told.stopped == "callback" and told.evaluations == 5

    class Stopper:
        def on_evaluation(self, event: Event) -> None:
            assert event.loss == event.best_loss
            raise StopFitting

    told = fit(disk(), target(), SPACE, callbacks=[Stopper()], **arguments)
    assert told.stopped == "callback" and told.evaluations == 1


def test_an_infinite_loss_is_no_best_and_stops_nothing(tmp_path: Path) -> None:
    def log_of_mean(images: Any) -> Any:
        means = images.mean(axis=(1, 2, 3))
        dark.extend(means < 0.2)
        return np.where(means < 0.2, -np.inf, means)

    dark: list[bool] = []

    arguments: dict[str, Any] = {"loss": log_of_mean, "workers": 0, "seed": 0}
    result = fit(disk(), target(), SPACE, 30, stop_at=-5, out=tmp_path / "run", **arguments)
    assert result.stopped == "budget" and result.best is not None
    assert any(dark) and np.isfinite(result.best.loss)
    more = fit(disk(), target(), SPACE, 40, out=tmp_path / "run", resume=True, **arguments)
    assert more.evaluations == 40 and more.best is not None and np.isfinite(more.best.loss)


def test_a_hopeless_fit_stops_when_it_stalls() -> None:
    def constant(params: dict[str, float]) -> Any:
        return np.full((16, 16), 0.3)

    with pytest.warns(RuntimeWarning, match="all images of the first 32 candidates"):
        result = fit(constant, target(), SPACE, None, until_stalled=True, workers=0, seed=0)
    assert result.stopped == "stalled"
    assert 20 * 8 <= result.evaluations < 2000 and result.status.code != "improving"


# -- bad input -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"budget": 0}, "budget must be a whole number >= 1, not 0"),
        ({"budget": None}, "budget=None needs another rule"),
        ({"until": "sol"}, "until must be 'solved', 'stalled', 'budget', not 'sol"),
        ({"stop_at": "low"}, "stop_at must be a finite number"),
        ({"workers": 0, "timeout": 3}, "timeout needs a worker that can be killed"),
        ({"executor": "ship"}, "executor must be 'processes', 'threads'"),
        ({"resume": True}, "resume=True needs the run directory"),
        ({"callbacks": [3]}, "a callback must be a function or have one of on_eval"),
        ({"popsiz": 3}, "fit has no option 'popsiz' .did you mean 'popsize'"),
    ],
)
def test_bad_arguments_are_named_before_anything_is_rendered(
    arguments: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(FideError, match=message) as caught:
        fit(disk(log=tmp_path / "log"), target(), SPACE, **arguments)
    assert isinstance(caught.value, ValueError) and not (tmp_path / "log").exists()
    with pytest.raises(OptionError, match="render must be a function"):
        fit("scene.py", target(), SPACE)  # type: ignore[arg-type]
    for space in ("space.toml", None, SPACE.to_dict(), 0):
        with pytest.raises(OptionError, match=r"^space must be a Space, or the number of.*read"):
            fit(disk(), target(), space, workers=0)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="space must be at most 10,000 parameters, not 100,000"):
        fit(disk(), target(), 100_000, workers=0)
