"""Long runs: nothing drifts, nothing grows."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from fide_plugins.fide import FIDE

SLOW = pytest.mark.slow
TELLS = [5_000, pytest.param(1_000_000, marks=[SLOW, pytest.mark.timeout(3000)])]


def resident() -> int:
    """Bytes of memory that this process has now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.thorough
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc here")
@pytest.mark.parametrize("tells", TELLS)
def test_tells_in_flat_memory(tells: int, tmp_path: Path) -> None:
    """With images, restarts and lost candidates; the checkpoint does not grow either."""
    rng = np.random.default_rng(0)
    opt = FIDE(2, np.zeros((1, 1, 3)), popsize=20, seed=0)
    sizes, memory = [], []
    while opt.evaluations < tells:
        X = opt.ask(20)
        X = X[rng.random(20) < 0.9]
        images = np.repeat(X.mean(axis=1), 3).reshape(len(X), 1, 1, 3)
        opt.tell(X, images, X.mean(axis=1))
        if opt.state.population.generations % max(1, tells // 2000) == 0:
            opt.save(tmp_path / "checkpoint")
            sizes.append((tmp_path / "checkpoint").stat().st_size)
            memory.append(resident())
    third = len(sizes) // 3
    assert max(sizes[third:]) <= 1.2 * max(sizes[:third]) + 4e6  # of at most 20,000 that are out
    assert max(memory[third:]) <= max(memory[:third]) + 3e7
