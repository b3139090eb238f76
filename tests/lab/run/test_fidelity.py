"""A run whose samples of a pixel rise: the best candidate, resuming, what it refuses."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import run as harness
from fide_lab.run.pixel_samples import Fidelity
from fide_plugins.cli import main
from fide_plugins.errors import OptionError
from fide_plugins.recording.record import Record
from fide_plugins.types import Float64

TARGET = np.full((4, 4, 3), 0.3, np.float32)


class Grainy:
    """A plain color, with noise that falls with the root of the samples."""

    name, dim, seed, target = "grainy", 3, 0, TARGET

    def __init__(self, spp: int = 64) -> None:
        self.spp = spp
        self.taken: list[int] = []
        self.at_call: dict[int, Callable[[], None]] = {}

    def render(self, X: Float64, seed: Any = None) -> Any:
        self.taken += [self.spp] * len(X)
        self.at_call.get(len(self.taken), lambda: None)()
        shape, sigma = TARGET.shape, 0.1 / np.sqrt(self.spp)
        noise = [np.random.default_rng(s).normal(0, sigma, shape) for s in seed]
        return np.clip(X[:, None, None, :] + noise, 0, 1).astype(np.float32)

    def reference(self, x: Float64) -> Any:
        return np.broadcast_to(x, TARGET.shape)


def run(task: Grainy, least: int = 1, budget: int = 1500, **settings: Any) -> harness.RunResult:
    return harness.run(task, "cma", budget=budget, task_options={"least_spp": least}, **settings)


def test_samples_rise_as_the_search_narrows() -> None:
    task = Grainy()
    result = run(task, budget=600)
    assert task.taken[0] == 1 and task.taken[-1] == 64
    assert task.taken == sorted(task.taken)
    assert result.samples == sum(task.taken) < 600 * 64 * 0.8
    assert 600 < len(task.taken) < 600 * 1.08  # some are rendered twice
    assert task.spp == 64  # as it was
    assert result.details()["samples"] == result.samples


@pytest.mark.thorough
def test_it_finds_what_many_samples_find_and_few_do_not() -> None:
    """Judged by references: as good as with 64 throughout, better than with one."""

    def median(spp: int = 64, least: int = 1) -> float:
        runs = [run(Grainy(spp), least, seed=seed) for seed in range(5)]
        return float(np.median([result.reference_loss for result in runs]))

    rising = median()
    assert rising < median(spp=1) / 3
    assert rising < 10 * median(least=64)


def test_samples_that_never_rise_are_counted_too() -> None:
    assert run(Grainy(), 64, budget=150).samples == 150 * 64


def test_candidates_of_one_generation_have_the_same_samples() -> None:
    """Also where a generation is rendered in pieces; what is rendered twice stands in between."""
    task = Grainy()
    task.taken, calls = [], []
    render = task.render

    def noted(X: Float64, seed: Any = None) -> Any:
        if seed[0] < 2**39:  # not a second render
            calls.append((task.spp, len(X)))
        return render(X, seed)

    task.render = noted  # type: ignore[method-assign]
    result = harness.run(
        task, "cma", budget=1500, options={"popsize": 100}, task_options={"least_spp": 1}
    )
    numbers = np.repeat(*np.transpose(calls)).reshape(-1, 100)
    assert set(result.generations) == {100} and len(set(numbers[:, 0])) > 2
    assert (numbers == numbers[:, :1]).all()


def test_what_was_best_is_rendered_once_more_before_others_can_take_its_place() -> None:
    """A render that was lucky at one sample is worth at four what it is there."""
    task, record = Grainy(16), Record()
    fidelity = Fidelity(task, 1)
    X, images = np.full((4, 3), 0.5), np.zeros((4, *TARGET.shape), np.float32)
    nothing = np.empty(0)
    losses = np.array([0.0, 3.0, 2.0, 1.0])
    fidelity.note(record, losses, images[:0], nothing)
    record.add(X, images, losses)
    assert (record.best_loss, len(fidelity.extra_points(X, record))) == (0.0, 0)
    fidelity.rule.number = 4
    assert fidelity.extra_points(X, record).tolist() == [X[0].tolist()]
    fidelity.note(record, losses, images[:1] + 0.5, np.array([2.5]))
    assert record.best_loss == 2.5 and record.image is not None and record.image.min() == 0.5
    assert len(fidelity.extra_points(X, record)) == 0
    assert fidelity.total == 4 * 1 + 5 * 4


def test_resuming_gives_the_uninterrupted_result(tmp_path: Path) -> None:
    whole = run(Grainy(), budget=400)
    for stop in (100, 230, 345):  # renders, of whatever number
        task, out = Grainy(), tmp_path / str(stop)
        calls = {n: lambda: os.kill(os.getpid(), signal.SIGINT) for n in range(stop, stop + 9)}
        task.at_call = calls
        with pytest.raises(harness.Interrupted):
            run(task, budget=400, out=out)
        resumed = run(Grainy(), budget=400, out=out, resume=True)
        assert resumed.losses.tobytes() == whole.losses.tobytes()
        assert (resumed.best_loss, resumed.samples) == (whole.best_loss, whole.samples)


class Plain:
    name, dim, seed, target = "plain", 3, 0, TARGET

    def render(self, X: Float64, seed: Any = None) -> Any:
        return np.zeros((len(X), *TARGET.shape), np.float32)


def test_refuses_what_cannot_be() -> None:
    with pytest.raises(OptionError, match="plain takes none"):
        harness.prepare(Plain(), "cma", task_options={"least_spp": 1})
    with pytest.raises(OptionError, match="least must not be above most, got 32 and 16"):
        run(Grainy(16), 32)


def test_the_command_line_refuses_it_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", "voronoi", "--size", "8", "--least-spp", "1", "--out", str(tmp_path / "a")]
    assert main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "voronoi takes none: leave it out" in captured.err
    assert len(captured.err.splitlines()) == 1
