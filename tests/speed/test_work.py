"""Work, counted: a fifth more of it for the same result fails.

Seconds depend on the machine and on who else is there; what is counted here does not.  Where a
change does less, lower the number; where more work buys something, raise it and say what it buys.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

import fide_tasks
from fide_plugins.fide import FIDE
from fide_plugins.proposers.diffusion import DiffusionProposer

BEGIN, END = 150, 600  # renders between which a run is watched; its buffers are full by then
MORE = 1.2

# For one candidate: calls of functions, Python's and C's; thousands of n^3 of eigendecompositions
# (n, n); images that are encoded.
WORK: dict[str, dict[str, float]] = {
    "fast": {"calls": 140, "eigen": 12, "images": 1},
    "balanced": {"calls": 150, "eigen": 31, "images": 1},
    "accurate": {"calls": 150, "eigen": 31, "images": 1},
}
TRAINING = 71.5  # million floating-point operations for an example, an epoch, as published at 112


@contextmanager
def calls(count: Counter[str]) -> Iterator[None]:
    """Count calls of functions within this block."""

    def note(frame: object, event: str, argument: object) -> None:
        count["calls"] += event in ("call", "c_call")

    sys.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(None)


@cache
def work(preset: str) -> dict[str, float]:
    """Work for one candidate of a run of Voronoi, all but rendering."""
    count: Counter[str] = Counter()
    task = fide_tasks.make("voronoi", size=56, seed=0)
    opt = FIDE(task.dim, task.target, preset=preset, seed=0, device="cpu")
    compute, eigh = opt._encoder.compute, np.linalg.eigh

    def counted_compute(batch: Any) -> Any:
        count["images"] += len(batch)
        return compute(batch)

    def counted_eigh(matrix: Any) -> Any:
        count["eigen"] += len(matrix) ** 3
        return eigh(matrix)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(opt._encoder, "compute", counted_compute)
        patch.setattr(np.linalg, "eigh", counted_eigh)
        began = 0
        while opt.evaluations < END:
            if opt.evaluations < BEGIN:
                count.clear()
                began = opt.evaluations
            with calls(count):
                X = opt.ask()
            images = task.render(X)
            with calls(count):
                opt.tell(X, images)
    n = opt.evaluations - began
    return {"calls": count["calls"] / n, "eigen": count["eigen"] / n / 1000,
            "images": count["images"] / n}  # fmt: skip


@pytest.mark.parametrize("what", ["calls", "eigen", "images"])
@pytest.mark.parametrize("preset", WORK)
def test_work_for_one_candidate(preset: str, what: str) -> None:
    found, stated = work(preset)[what], WORK[preset][what]
    assert found < MORE * stated, f"{preset} does {found:.4g} {what} a candidate, not {stated}"
    assert found > stated / 2, f"{preset} does less {what}, {found:.4g}: lower the number"


def test_work_of_training() -> None:
    proposer = DiffusionProposer(40, epochs=1)
    x, tokens = np.random.default_rng(0).random((50, 40)), torch.rand(50, 49, 768)
    with FlopCounterMode(display=False) as counter:
        proposer.update(x, tokens, None, np.full(40, 0.1))
    found = counter.get_total_flops() / 50 / 1e6
    assert TRAINING / 2 < found < MORE * TRAINING
    with FlopCounterMode(display=False) as counter:
        proposer.propose(x, tokens[0], x[0], np.full(40, 0.1))
    assert counter.get_total_flops() / 50 / 1e6 < TRAINING  # three steps of a third each


def test_what_is_counted_grows_with_the_work() -> None:
    """The counter itself: twice the calls are twice the count."""
    counts = []
    for repeats in (50, 100):
        count: Counter[str] = Counter()
        with calls(count):
            for _ in range(repeats):
                np.zeros(1).sum()
        counts.append(count["calls"])
    assert 1.8 < counts[1] / counts[0] < 2.2
