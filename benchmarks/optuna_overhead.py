"""What a trial costs beyond rendering, in Optuna and without, up to trial 20,000.

    python benchmarks/optuna_overhead.py

20 parameters, images of 32 x 32, everything in memory, processor time of this process.  *Core* is
the optimizer asked and told one candidate at a time; *Optuna itself* is a study whose sampler draws
at random; *FIDE beyond both* is what is left of a trial with `FIDESampler`.  `CmaEsSampler` is
measured beside it, on a study that was filled with trials of its space and continued.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from functools import partial
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import optuna
from optuna.distributions import FloatDistribution
from optuna.samplers import BaseSampler, CmaEsSampler, RandomSampler

from fide_adapters.optuna import FIDESampler
from fide_plugins import FIDE

DIM, SIDE = 20, 32
MARKS = (1000, 5000, 10_000, 20_000)
WINDOW = 300  # trials that are timed, up to each mark
NAMES = [f"x{i}" for i in range(DIM)]
PATTERNS = np.random.default_rng(1).random((DIM, SIDE, SIDE, 3), np.float32)


def render(x: Any) -> Any:
    """Sum of patterns, weighted by x."""
    image = np.tensordot(np.asarray(x, np.float32), PATTERNS, 1) * (2 / DIM) - 0.5
    return np.clip(image, 0.0, 1.0)


TARGET = render(np.random.default_rng(0).random(DIM))


def timed(step: Callable[[], None], n: int) -> float:
    """Milliseconds of processor time of one of n steps."""
    start = time.process_time()
    for _ in range(n):
        step()
    return 1000 * (time.process_time() - start) / n


def at_marks(step: Callable[[], None]) -> list[float]:
    """Milliseconds of a step, in a window that ends at each mark."""
    done, results = 0, []
    for mark in MARKS:
        while done < mark - WINDOW:
            step()
            done += 1
        results.append(timed(step, WINDOW))
        done = mark
    return results


def study_step(study: optuna.Study, judge: Callable[[optuna.Trial, Any], float]) -> None:
    """One trial; rendering is not part of it."""
    trial = study.ask()
    x = [trial.suggest_float(name, 0, 1) for name in NAMES]
    study.tell(trial, judge(trial, x))


def with_sampler(sampler: BaseSampler) -> list[float]:
    """Milliseconds a trial at the marks."""
    study = optuna.create_study(sampler=sampler)
    if isinstance(sampler, FIDESampler):
        return at_marks(
            lambda: study_step(study, lambda trial, x: sampler.tell_image(trial, render(x)))
        )
    return at_marks(partial(study_step, study, sphere))


def with_core() -> list[float]:
    """Milliseconds a candidate at the marks."""
    optimizer = FIDE(DIM, TARGET, seed=0)

    def step() -> None:
        x = optimizer.ask(1)
        optimizer.tell(x, render(x[0])[None])

    return at_marks(step)


def with_cma() -> list[float]:
    """Milliseconds a trial of CmaEsSampler where a study has as many trials as each mark."""
    results = []
    space = {name: FloatDistribution(0, 1) for name in NAMES}
    rng = np.random.default_rng(0)
    for mark in MARKS:
        study = optuna.create_study(sampler=CmaEsSampler(seed=0))
        study.add_trials(
            [
                optuna.create_trial(
                    params=dict(zip(NAMES, x.tolist(), strict=True)),
                    distributions=space,
                    value=float(x.sum()),
                )
                for x in rng.random((mark - WINDOW, DIM))
            ]
        )
        results.append(timed(partial(study_step, study, sphere), WINDOW))
    return results


def sphere(trial: optuna.Trial, x: list[float]) -> float:
    """Loss without an image."""
    return float(np.square(np.array(x) - 0.3).sum())


def main() -> None:
    """Measure and print."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    drawing = timed(lambda: render(np.zeros(DIM)), WINDOW)
    core = [ms - drawing for ms in with_core()]
    optuna_itself = with_sampler(RandomSampler(seed=0))
    fide = [ms - drawing for ms in with_sampler(FIDESampler(TARGET, seed=0))]
    cma = with_cma()
    rows = {
        "FIDESampler, whole trial": fide,
        "core": core,
        "Optuna itself": optuna_itself,
        "FIDE beyond both": [f - c - o for f, c, o in zip(fide, core, optuna_itself, strict=True)],
        "CmaEsSampler, whole trial": cma,
        "CmaEsSampler beyond Optuna": [c - o for c, o in zip(cma, optuna_itself, strict=True)],
    }
    print("| ms a trial | " + " | ".join(f"at {mark:,}" for mark in MARKS) + " |")
    print("|---|" + "---|" * len(MARKS))
    for name, values in rows.items():
        print(f"| {name} | " + " | ".join(f"{value:.2f}" for value in values) + " |")
    print(json.dumps({"date": time.strftime("%Y-%m-%d"), **rows}))


if __name__ == "__main__":
    main()
