"""What a trial costs, in time and in memory (acceptance points 15 and 18, in full length)."""

from __future__ import annotations

import pickle
import time
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.trial import Trial

from fide_adapters.optuna import FIDESampler

from .conftest import Bench

pytestmark = pytest.mark.slow

DIM, SIDE = 20, 32
PATTERNS = np.random.default_rng(1).random((DIM, SIDE, SIDE, 3), np.float32)


def render(x: Any) -> Any:
    return np.clip(np.tensordot(np.asarray(x, np.float32), PATTERNS, 1) * (2 / DIM) - 0.5, 0, 1)


def test_point_15_five_milliseconds_at_trial_1000_and_no_more_at_trial_4000() -> None:
    """Processor time of asking and telling, without rendering; the median of blocks of 50."""
    target = render(np.random.default_rng(0).random(DIM))
    sampler = FIDESampler(target, seed=0)
    study = optuna.create_study(sampler=sampler)

    def objective(trial: Trial) -> float:
        x = [trial.suggest_float(f"x{i}", 0, 1) for i in range(DIM)]
        start = time.process_time()
        image = render(x)
        rendering.append(time.process_time() - start)
        return sampler.tell_image(trial, image)

    medians = []
    for _ in range(4):
        blocks = []
        for _ in range(20):
            rendering: list[float] = []
            start = time.process_time()
            study.optimize(objective, n_trials=50)
            blocks.append((time.process_time() - start - sum(rendering)) / 50)
        medians.append(float(np.median(blocks)))
    assert medians[0] < 5e-3
    assert medians[3] < 1.5 * medians[1] + 5e-4


def test_point_18_memory_does_not_grow_with_trials(bench: Bench) -> None:
    """What a sampler holds apart from the storage: ten times the trials, a tenth more of it."""
    study = optuna.create_study(sampler=bench.sampler(search_space=bench.space))
    sizes = []
    for trials in (1000, 9000):
        bench.run(study, trials)
        sizes.append(len(pickle.dumps(study.sampler)))
    assert sizes[1] < 1.1 * sizes[0] + 10_000
