"""Many threads, processes and lost candidates: defined, and nothing is used twice."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64

DIM, SIZE = 4, 8
WORKERS = 8


def render(X: Float64) -> Float32:
    weights = np.random.default_rng(3).standard_normal((DIM, SIZE * SIZE * 3))
    images: Float32 = (1 / (1 + np.exp((0.5 - X) @ weights))).astype(np.float32)
    return images.reshape(len(X), SIZE, SIZE, 3)


TARGET = render(np.full((1, DIM), 0.7))[0]


def in_threads(work: Callable[[int], None]) -> None:
    """Run it in eight threads; raises what any of them raised."""
    with ThreadPoolExecutor(WORKERS) as pool:
        for done in [pool.submit(work, i) for i in range(WORKERS)]:
            done.result(timeout=120)


def test_eight_threads_ask_and_tell_and_nothing_is_lost_or_used_twice() -> None:
    opt = FIDE(DIM, TARGET, popsize=6, seed=0)
    asked: list[list[Float64]] = [[] for _ in range(WORKERS)]
    best: list[float] = []
    start = threading.Barrier(WORKERS)

    def work(worker: int) -> None:
        rng = np.random.default_rng(worker)
        start.wait()
        for _ in range(12):
            X = opt.ask(int(rng.integers(1, 4)))
            asked[worker].append(X)
            for row in rng.permutation(len(X)):
                opt.tell(X[row : row + 1], render(X[row : row + 1]))
            assert opt.best is not None
            best.append(opt.best.loss)

    in_threads(work)
    X = np.concatenate([x for several in asked for x in several])
    assert opt.evaluations == len(X)
    same = len(X) - len(np.unique(X, axis=0))
    assert same <= 12, "up to three tests of exchangeable blocks render their optimum again"
    assert ((X >= 0) & (X <= 1)).all()
    losses = np.square(render(X).astype(np.float64) - TARGET).mean(axis=(1, 2, 3))
    assert opt.best is not None and opt.best.loss == pytest.approx(losses.min(), rel=1e-12)
    assert len(opt.state.population.pending) == 0
    assert opt.state.population.generations >= len(X) // (6 * 4)


def test_a_generation_told_by_eight_threads_is_the_generation_told_at_once(tmp_path: Path) -> None:
    whole, pieces = (FIDE(DIM, TARGET, popsize=16, seed=1) for _ in range(2))
    for _ in range(6):
        X = whole.ask()
        whole.tell(X, render(X))
        np.testing.assert_array_equal(pieces.ask(), X)
        rows = np.array_split(np.random.default_rng(0).permutation(16), WORKERS)

        def work(worker: int, X: Float64 = X, rows: Any = rows) -> None:
            mine = X[rows[worker]]
            pieces.tell(mine, render(mine))

        in_threads(work)
    np.testing.assert_array_equal(whole.ask(), pieces.ask())
    ours, theirs = whole.state.search.distribution, pieces.state.search.distribution
    np.testing.assert_array_equal(ours.C, theirs.C)
