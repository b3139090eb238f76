"""The loop that `fit` and the runs of the lab share: pieces, budget, what is pending, errors."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fide_lab import run as harness
from fide_plugins import fit
from fide_plugins.fitting.loop import Loop
from fide_plugins.fitting.stopping import Stopping
from fide_plugins.fitting.workers import InThisProcess
from fide_plugins.recording.record import Record
from fide_plugins.recording.signals import Interrupts
from fide_plugins.types import Float64

from .scene import SPACE, disk, target


class Generations:
    """Steps with generations of five candidates; the loss is the number of an evaluation."""

    def __init__(self, budget: int, piece: int | None, record: Record | None = None) -> None:
        optimizer: Any = SimpleNamespace(dim=1, times={}, training=False)
        self.record, self.rendered, self.told = record or Record(), list[Any](), list[int]()
        self.asked, self.shown, self.saved = 0, 0, 0
        self.fails_at = -1
        self.loop = Loop(
            self, optimizer, InThisProcess(self._render), Stopping(budget, until="budget"),
            self.record, Interrupts(), piece=piece, checkpoint_every=0.0,
        )  # fmt: skip

    def _render(self, X: Float64) -> Any:
        self.rendered.append(np.shape(X))
        return X

    def ask(self) -> Float64:
        first = self.asked
        self.asked += 5
        return np.arange(first, first + 5.0)[:, None]

    def tell(self, X: Float64, outcome: Any) -> bool:
        if len(self.told) == self.fails_at:
            self.loop.put_back(X)
            raise ValueError("no loss")
        assert np.array_equal(np.reshape(outcome, (-1, 1)), X)
        self.told.append(len(X))
        return any([self.record.add_one(x, None, float(x[0])) for x in X])

    def show(self, last: bool) -> None:
        self.shown += 1

    def save(self) -> None:
        self.saved += 1
        self.record.pending = self.loop.pending


@pytest.mark.parametrize(
    ("piece", "told"), [(3, [3, 2, 3]), (32, [5, 3]), (1, [1] * 8), (None, [1] * 8)]
)
def test_a_generation_is_rendered_in_pieces_to_the_end_of_the_budget(
    piece: int | None, told: list[int]
) -> None:
    steps = Generations(8, piece)
    assert steps.loop.run() == "budget"
    assert steps.told == told and list(steps.record.losses) == list(range(8))
    assert steps.rendered == [(1,) if piece is None else (n, 1) for n in told]
    assert steps.loop.pending.tolist() == [[8.0], [9.0]], "asked, beyond the budget"
    assert steps.shown == len(told) + 1 and steps.saved >= len(told)
    longer = Generations(10, piece, steps.record)
    assert longer.loop.run() == "budget" and not longer.asked, "what was pending comes first"
    assert list(steps.record.losses) == list(range(10))


def test_what_cannot_be_told_is_rendered_again() -> None:
    steps = Generations(8, 3)
    steps.fails_at = 1
    with pytest.raises(ValueError, match="no loss"):
        steps.loop.run()
    assert steps.loop.whole and steps.loop.pending.tolist() == [[3.0], [4.0]]
    steps.fails_at = -1
    assert steps.loop.run() == "budget" and list(steps.record.losses) == list(range(8))


def test_a_fit_and_a_run_of_the_lab_have_the_same_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    runs, run = [], Loop.run

    def noted(self: Loop) -> str:
        runs.append(type(self))
        return run(self)

    monkeypatch.setattr(Loop, "run", noted)
    fit(disk(), target(), SPACE, budget=10, workers=0, seed=0)
    harness.run("voronoi", "random", budget=10, size=16)
    assert runs == [Loop, Loop]
