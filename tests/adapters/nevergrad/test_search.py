"""The same as FIDE alone, and the same again (points 4 and 21); dumps in mid-run (22)."""

from __future__ import annotations

import pickle
import random
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import nevergrad as ng
import numpy as np
import pytest
import torch

from fide_adapters.nevergrad import FIDE as REGISTERED, NoImagesWarning
from fide_plugins.errors import ProtocolError
from fide_plugins.types import Float32, Float64

from .conftest import box, fide, render, told


def test_without_a_target_it_says_so_once() -> None:
    optimizer = fide(target=None)
    with pytest.warns(NoImagesWarning, match=r"no target.*CMA-ES") as record:
        for _ in range(30):
            candidate = optimizer.ask()
            optimizer.tell(candidate, 1.0)
    assert len(record) == 1


def never(x: Any) -> bool:
    return False


def run(seed: int, parametrization: Any) -> list[Float64]:
    optimizer = fide(parametrization, seed=None)
    optimizer.parametrization.random_state.seed(seed)
    return told(optimizer, 40)


def test_point_21_the_random_state_of_the_parametrization_is_the_seed() -> None:
    first, again, other = run(5, box()), run(5, box()), run(6, box())
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[0], other[0])
    seeded = box()
    seeded.random_state.seed(5)
    optimizer = fide(seeded, seed=None)
    np.testing.assert_array_equal(told(optimizer, 40), first)


def test_point_21_global_random_state_is_left_alone() -> None:
    optimizer = fide(seed=None)
    optimizer.parametrization.random_state.seed(1)
    np.random.seed(7)
    torch.manual_seed(7)
    random.seed(7)
    told(optimizer, 40)
    drawn = np.random.random(), torch.rand(1).item(), random.random()
    np.random.seed(7)
    torch.manual_seed(7)
    random.seed(7)
    assert drawn == (np.random.random(), torch.rand(1).item(), random.random())


# -- dumps -----------------------------------------------------------------------------------------

SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "published": {"preset": "paper", "popsize": 6, "options": {"epochs": 1, "batch_size": 6}},
    "losses only": {"options": {"proposer": "none"}},
}


@pytest.mark.parametrize("steps", [0, 4, 40])
@pytest.mark.parametrize("what", SETTINGS)
def test_point_22_continues_identically(what: str, steps: int, tmp_path: Path) -> None:
    """With candidates out, which either may be told."""
    original = fide(**SETTINGS[what])
    told(original, steps)
    out = [original.ask() for _ in range(3)]
    original.dump(tmp_path / "dump")
    copy = REGISTERED.load(tmp_path / "dump")
    assert copy.name == original.name and copy.num_ask == original.num_ask
    theirs = pickle.loads(pickle.dumps(out))  # as they come back from elsewhere
    for ours, its in zip(out, theirs, strict=True):
        original.tell(ours, render(ours.value))
        copy.tell(its, render(its.value))
    np.testing.assert_array_equal(told(original, 20), told(copy, 20))
    assert copy.num_tell == original.num_tell and copy.num_tell_not_asked == 0
    np.testing.assert_array_equal(copy.recommend().value, original.recommend().value)


def test_a_dump_of_another_version_is_refused() -> None:
    state = fide().__getstate__()
    with pytest.raises(ProtocolError, match="another version"):
        fide().__setstate__({**state, "_format": 1})


class DumpAt:
    """Dump at one of the calls."""

    def __init__(self, path: Path, at: int) -> None:
        self.path, self.at, self.calls = path, at, 0

    def __call__(self, optimizer: Any, *_: Any) -> None:
        self.calls += 1
        if self.calls == self.at:
            ng.callbacks.OptimizerDump(self.path)(optimizer)


def remember(values: list[Any]) -> Any:
    def called(x: Any) -> Float32:
        values.append(np.array(x))
        return render(x)

    return called


@pytest.mark.parametrize("event", ["ask", "tell"])
@pytest.mark.parametrize("mode", [{"batch_mode": True}, {"batch_mode": False}])
def test_point_22_from_a_callback_in_minimize(
    event: str, mode: dict[str, Any], tmp_path: Path
) -> None:
    """What was with the executor is asked and rendered again, then all goes on as it did."""
    values: list[Any] = []
    original = fide(budget=60)
    original.register_callback(event, DumpAt(tmp_path / "dump", 25))
    expected = original.minimize(remember(values), **mode)
    again: list[Any] = []
    copy = REGISTERED.load(tmp_path / "dump")
    copy.remove_all_callbacks()
    assert copy.num_tell == 24
    recommended = copy.minimize(remember(again), **mode)
    np.testing.assert_array_equal(again, values[24:])
    assert copy.num_tell == copy.num_ask == 60 and copy.num_tell_not_asked == 0
    np.testing.assert_array_equal(recommended.value, expected.value)


def test_point_22_with_running_futures(tmp_path: Path) -> None:
    """OptimizerDump at every tell, with threads that cannot be pickled."""
    lock = threading.Lock()

    def slow(x: Any) -> Float32:
        with lock:
            time.sleep(0.001)
        return render(x)

    original = fide(budget=40, workers=4)
    original.register_callback("tell", ng.callbacks.OptimizerDump(tmp_path / "dump"))
    with ThreadPoolExecutor(4) as executor:
        original.minimize(slow, executor=executor)
    copy = REGISTERED.load(tmp_path / "dump")
    assert copy.num_tell == 39 and len(copy._repeated) == 1
    copy.remove_all_callbacks()
    with ThreadPoolExecutor(4) as executor:
        copy.minimize(slow, executor=executor)
    assert copy.num_tell == copy.num_ask == 40
    np.testing.assert_allclose(copy.recommend().value, original.recommend().value)
