"""Callbacks are called in order, and stop a fit."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins import fit
from fide_plugins.fitting.callbacks import Event
from fide_plugins.fitting.result import Result

from .scene import SPACE, disk, target


class Diary:
    def __init__(self) -> None:
        self.calls: list[str] = []
        self.events: list[Event] = []

    def on_evaluation(self, event: Event) -> None:
        self.calls.append("evaluation")
        self.events.append(event)

    def on_end(self, result: Result) -> None:
        self.calls.append("end")
        self.result = result


def test_an_event_says_what_was_evaluated() -> None:
    diary = Diary()
    result = fit(disk(), target(), SPACE, budget=30, workers=0, seed=1, callbacks=[diary])
    assert diary.calls == ["evaluation"] * 30 + ["end"] and diary.result is result
    losses = [event.loss for event in diary.events]
    lows = np.minimum.accumulate(losses)
    assert [event.best_loss for event in diary.events] == lows.tolist()
    assert [event.evaluation for event in diary.events] == list(range(30))
    for event in diary.events[::7]:
        assert event.params == SPACE.decode(event.x)
        gray = np.repeat(disk()(event.params)[..., None], 3, axis=-1)
        assert event.image == pytest.approx(gray, abs=1e-6)


@pytest.mark.parametrize(("answer", "stops"), [(True, True), (np.True_, True), (np.False_, False),
    (1, False), (np.ones(2), False), (None, False)])  # fmt: skip
def test_a_callback_stops_with_true_of_python_or_numpy(answer: object, stops: bool) -> None:
    """A condition on `event.x` is NumPy's."""
    result = fit(
        disk(), target(), SPACE, budget=9, workers=0, seed=1, callbacks=lambda event: answer
    )
    assert result.evaluations == (1 if stops else 9)
