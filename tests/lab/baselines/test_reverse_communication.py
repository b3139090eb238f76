"""Functions that call back, turned around."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from fide_lab.baselines.libraries import ReverseCommunication


def count(function: Callable[[Any], Any]) -> None:
    """Evaluate 0, then the sums of all values so far, three in all."""
    total = np.zeros(1)
    for _ in range(3):
        total = total + function(total)


def test_points_and_values_go_to_and_fro() -> None:
    caller = ReverseCommunication(count)
    seen = []
    while (point := caller.point()) is not None:
        seen.append(float(point[0]))
        caller.answer(2.0 + len(seen))
    assert seen == [0.0, 3.0, 7.0]
    assert caller.over and caller.point() is None


def test_the_point_stays_until_it_is_answered() -> None:
    caller = ReverseCommunication(count)
    first, again = caller.point(), caller.point()
    assert first is again
    caller.close()


def test_an_error_of_the_library_reaches_the_user() -> None:
    def search(function: Callable[[Any], Any]) -> None:
        function(np.zeros(1))
        raise ZeroDivisionError("in the library")

    caller = ReverseCommunication(search)
    caller.point()
    with pytest.raises(ZeroDivisionError, match="in the library"):
        caller.answer(1.0)
    assert caller.over


@pytest.mark.parametrize("how", ["close", "forget"])
def test_a_search_is_cancelled_and_cleans_up(how: str) -> None:
    left = []

    def search(function: Callable[[Any], Any]) -> None:
        try:
            while True:
                function(np.zeros(1))
        except Exception:  # a library may catch all errors, and yet is to end
            left.append("caught")
        finally:
            left.append("left")

    before = threading.active_count()
    caller: ReverseCommunication | None = ReverseCommunication(search)
    assert caller is not None and caller.point() is not None
    assert threading.active_count() == before + 1
    if how == "close":
        caller.close()
        caller.close()
        assert caller.point() is None
    caller = None
    assert threading.active_count() == before and left == ["left"]


def test_the_surroundings_are_those_of_the_library_while_it_runs() -> None:
    inside = []

    @contextmanager
    def around() -> Iterator[None]:
        inside.append("in")
        yield
        inside.append("out")

    caller = ReverseCommunication(count, around)
    while caller.point() is not None:
        assert inside.count("in") == inside.count("out")
        caller.answer(0.0)
    assert inside == ["in", "out"] * 4


def test_the_surroundings_are_those_of_the_library_after_ctrl_c_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    depth, depths = 0, []

    @contextmanager
    def around() -> Iterator[None]:
        nonlocal depth
        depth += 1
        try:
            yield
        finally:
            depth -= 1

    caller = ReverseCommunication(count, around)
    wait = caller._wait

    def interrupted() -> None:
        depths.append(depth)
        if len(depths) == 1:
            raise KeyboardInterrupt
        wait()

    monkeypatch.setattr(caller, "_wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        caller.point()
    assert caller.point() is not None
    assert depths == [1, 1] and depth == 0
    caller.close()


def test_python_exits_while_a_search_waits() -> None:
    program = (
        "from fide_lab.baselines.libraries import ReverseCommunication\n"
        "caller = ReverseCommunication(lambda function: [function([0.0]) for _ in range(9)])\n"
        "print(caller.point())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    assert (done.stdout, done.stderr) == ("[0.]\n", "")
