"""What is kept of a run, and that it is bounded."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fide_plugins.population import Memory, TrainingSample

TOKENS = torch.zeros(16, 80)  # 5,120 bytes
BYTES = 5120 + 16
SIDES = {"d": 2, "T": 16, "C": 80}


def sample(i: int) -> TrainingSample:
    return TrainingSample(i, np.full(2, 0.5), TOKENS + i, float(i), 2 * i)


def filled(n: int, room: int = 20) -> Memory:
    memory = Memory(room * BYTES / 2**20)
    for i in range(n):
        memory.add(sample(i))
    return memory


@pytest.mark.parametrize("n", [0, 1, 10, 20, 21, 1000, 5000])
def test_it_holds_what_there_is_room_for(n: int) -> None:
    kept = [one.index for one in filled(n).samples]
    assert len(kept) <= 20 and kept == sorted(set(kept))
    assert kept[-10:] == list(range(max(0, n - 10), n)), "the latest"
    assert len(kept) >= min(n, 15)


def test_earlier_ones_are_spread_over_the_run() -> None:
    kept = [one.index for one in filled(5000).samples][:-10]
    gaps = np.diff([0, *kept, 4990])
    assert gaps.max() <= 2 * np.median(gaps)


def test_it_goes_on_from_a_saved_state() -> None:
    for n in (0, 3, 10, 11, 333):
        saved, copy = filled(n), Memory(20 * BYTES / 2**20)
        copy.load_state_dict(saved.state_dict(), SIDES)
        for i in range(n, n + 50):
            saved.add(sample(i))
            copy.add(sample(i))
        pairs = list(zip(saved.samples, copy.samples, strict=True))
        assert all((a.index, a.loss) == (b.index, b.loss) for a, b in pairs)
        assert all(torch.equal(a.tokens, b.tokens) for a, b in pairs)
