"""Training by the clock: what is done when the time is up, and how it goes on."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from torch import Tensor

from fide_plugins.learning.networks import Network
from fide_plugins.learning.training import Training

PERIOD = 10.0  # seconds of a step, by a clock of our own


class Stepping(Training):
    """Notes the rate of each step, which takes ten seconds."""

    rates: list[float]
    now: list[float]

    def _step(self, loss: Tensor) -> None:
        self.rates.append(self._optimizer.param_groups[0]["lr"])
        self.now[0] += PERIOD
        super()._step(loss)


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def training(now: list[float], seconds: float | None, passes: int = 4) -> Stepping:
    """Of two gray levels, in ten steps a pass."""
    x = np.random.default_rng(0).random((1300, 2))
    images = np.repeat(np.uint8(x * 255), 8, axis=1)[:, :, None, None]  # (n, 16, 1, 1)
    images = np.broadcast_to(images, (1300, 16, 16, 3)).copy()
    network = Network((16, 16), (False, False), "autoregressive", (), 0)
    made = Stepping(network, x, images, passes, seconds=seconds, batch=128)
    made.rates, made.now = [], now
    return made


@pytest.mark.parametrize("extended", [False, True])
def test_a_longer_schedule_is_not_ended_by_the_best_of_the_shorter_one(
    now: list[float], extended: bool
) -> None:
    """After the second of two passes the rate is zero, after the second of twelve it is high."""
    longer = training(now, None, passes=12)
    held_out = [-40.0, -66.0, -65.0, -45.0, -45.0, -55.0, -63.0]
    longer.curve = [[1274.0 * k, 0.0, nats] for k, nats in enumerate(held_out, 1)]
    longer.passed, longer.extended = 7, extended
    assert longer.over == (not extended)
    longer.passed = 12
    assert longer.over


@pytest.mark.thorough
def test_training_stops_when_the_time_is_up_and_goes_on_with_more(now: list[float]) -> None:
    saved: list[dict[str, Any]] = []
    short = training(now, 14.5 * PERIOD)
    short.run(save=saved.append)
    assert len(short.rates) == 15 and min(short.rates) > 0
    assert short.passed == 1 and short.spent == 15 * PERIOD
    assert [row[0] for row in short.curve] == [1274, 1274 + 5 * 128]
    assert np.isfinite(short.curve[-1]).all()

    more = training(now, 1000 * PERIOD)
    more.load_state_dict(saved[-1])
    more.run()
    assert len(more.rates) == 30 and min(more.rates[:20]) > short.rates[-1]
    assert more.passed == 4 and more.spent == 45 * PERIOD
    assert [row[0] for row in more.curve] == [1274 * k for k in (1, 2, 3, 4)]


def test_no_time_is_one_step_and_no_pass(now: list[float]) -> None:
    least = training(now, 1e-3)
    least.run()
    assert (len(least.rates), least.passed, len(least.curve)) == (1, 0, 1)
    assert least.over
