"""A limit of time is shared by density and emulator, also where a call is interrupted."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torch import Tensor

from fide_plugins.learning import learn
from fide_plugins.learning.emulator import Emulator
from fide_plugins.learning.training import Training
from fide_plugins.runtime import checkpoint
from fide_plugins.types import Float64

SIDE = 16
STEP = 10.0  # seconds of a step of training, by a clock of our own; a render takes one
TIME = 404.0  # 101 for renders, 202 for the density, and 101 for the emulator


class Stop(Exception):
    """Raised while the emulator is learned."""


class Clock:
    """Time that passes where something is rendered or trained."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.now, self.steps = 0.0, 0
        self.stop_at: int | None = None
        """Step of the emulator that is interrupted."""
        step = Training._step

        def timed(training: Training, loss: Tensor) -> None:
            if isinstance(training.network, Emulator):
                if self.steps == self.stop_at:
                    raise Stop
                self.steps += 1
            self.now += STEP
            step(training, loss)

        patch.setattr(time, "monotonic", lambda: self.now)
        patch.setattr(Training, "_step", timed)
        # time alone ends it
        patch.setattr("fide_plugins.learning.training._PATIENCE", 1000)

    def render(self, x: Float64) -> Float64:
        """As bright as the sum of two lamps."""
        self.now += 1
        return np.full((SIDE, SIDE), x.mean())


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def learned(clock: Clock, out: Path, **options: Any) -> dict[str, dict[str, Any]]:
    """State of the trainings at the end of a call."""
    options = {"time": TIME, "passes": 1000, **options}
    learn(clock.render, 2, renders=100, size=SIDE, groups=[[0], [1]], out=out, **options)
    return states(out)


def states(out: Path) -> dict[str, dict[str, Any]]:
    folder = Path(f"{out}.renders")
    names = [name for name in ("training", "emulator") if (folder / name).exists()]
    return {name: checkpoint.read(folder / name, "training")["state"] for name in names}


@pytest.mark.thorough
def test_a_quarter_of_the_time_is_the_emulator_s(clock: Clock, tmp_path: Path) -> None:
    there = learned(clock, tmp_path / "m")
    assert there["training"]["spent"] == 210  # the step that is under way is finished
    assert there["emulator"]["spent"] == 100
    alone = learned(clock, tmp_path / "n", emulator=False)
    assert alone["training"]["spent"] == 310 and "emulator" not in alone


@pytest.mark.thorough
@pytest.mark.parametrize("stop_at", [2, 6])  # of four steps a pass
def test_an_interruption_in_the_emulator_s_time_is_not_the_density_s(
    stop_at: int, clock: Clock, tmp_path: Path
) -> None:
    """The next call has rendered before it begins, so it has more time: for the emulator."""
    clock.stop_at = stop_at
    with pytest.raises(Stop):
        learned(clock, tmp_path / "m")
    before = states(tmp_path / "m")["training"]
    clock.stop_at = None
    after = learned(clock, tmp_path / "m")
    assert after["training"]["curve"] == before["curve"]
    assert not after["training"]["extended"]
    assert after["emulator"]["spent"] > 0 and not after["emulator"]["extended"]
    more = learned(clock, tmp_path / "m", time=2 * TIME)  # which nothing has interrupted
    assert more["training"]["extended"]


def test_more_passes_are_the_density_s_too(clock: Clock, tmp_path: Path) -> None:
    """Also where an emulator of fewer passes was interrupted."""
    clock.stop_at = 6
    with pytest.raises(Stop):
        learned(clock, tmp_path / "m", time=None, passes=2)
    clock.stop_at = None
    there = learned(clock, tmp_path / "m", time=None, passes=3)
    assert there["training"]["passed"] == there["emulator"]["passed"] == 3
