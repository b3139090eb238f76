"""When the next checkpoint is due, by a clock that stands still."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from fide_plugins.recording import directory
from fide_plugins.recording.directory import CheckpointTimer, note_unsaved

IDLE: Any = SimpleNamespace(training=False)
TRAINS: Any = SimpleNamespace(training=True)


class Clock:
    """Seconds, as a test sets them."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(directory, "perf_counter", made)
    return made


def write(timer: CheckpointTimer, clock: Clock, seconds: float) -> None:
    with timer.writing():
        clock.now += seconds


def test_the_first_is_due_after_the_given_seconds(clock: Clock) -> None:
    timer = CheckpointTimer(5.0)
    clock.now += 4.0
    assert not timer.due(IDLE)
    clock.now += 1.0
    assert timer.due(IDLE)


@pytest.mark.parametrize(("took", "wait"), [(0.125, 5.0), (0.25, 5.0), (0.5, 10.0), (2.0, 40.0)])
def test_writing_takes_at_most_one_part_in_twenty(clock: Clock, took: float, wait: float) -> None:
    timer = CheckpointTimer(5.0)
    write(timer, clock, took)
    clock.now += wait - 0.125
    assert not timer.due(IDLE)
    clock.now += 0.125
    assert timer.due(IDLE)


def test_none_is_due_while_the_optimizer_trains(clock: Clock) -> None:
    timer = CheckpointTimer(5.0)
    clock.now += 60.0
    assert not timer.due(TRAINS)
    assert timer.due(IDLE)


def test_with_zero_seconds_one_is_always_due(clock: Clock) -> None:
    timer = CheckpointTimer(0)
    assert timer.due(IDLE)
    write(timer, clock, 3.0)
    assert timer.due(IDLE) and timer.due(TRAINS)


def test_one_that_cannot_be_written_does_not_count(clock: Clock) -> None:
    timer = CheckpointTimer(5.0)
    clock.now += 6.0
    with pytest.raises(OSError, match="full"), timer.writing():
        raise OSError("full")
    assert timer.due(IDLE)


def test_what_is_lost_is_noted_on_the_first_error() -> None:
    error = ValueError("the renderer fails")
    note_unsaved(error, OSError("the disk is full"))
    assert error.__notes__ == [
        "not everything could be written, perhaps no checkpoint: the disk is full"
    ]
