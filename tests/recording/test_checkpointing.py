"""When the next checkpoint is due, by a clock that stands still."""

from __future__ import annotations

import pytest

from fide_plugins.recording import directory
from fide_plugins.recording.directory import CheckpointTimer


@pytest.mark.parametrize(("took", "wait"), [(0.125, 5.0), (0.25, 5.0), (0.5, 10.0), (2.0, 40.0)])
def test_writing_takes_at_most_one_part_in_twenty(
    monkeypatch: pytest.MonkeyPatch, took: float, wait: float
) -> None:
    now = [100.0]
    monkeypatch.setattr(directory, "perf_counter", lambda: now[0])
    timer, always = CheckpointTimer(5.0), CheckpointTimer(0)
    now[0] += 5.0
    assert timer.due() and always.due()
    with pytest.raises(OSError, match="full"), timer.writing():
        raise OSError("full")
    assert timer.due(), "one that cannot be written does not count"
    with timer.writing():
        now[0] += took
    now[0] += wait - 0.125
    assert not timer.due()
    now[0] += 0.125
    assert timer.due()
