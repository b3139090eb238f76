"""Time of a trial beyond rendering, with Optuna and without, up to trial 20,000.

    python benchmarks/optuna_overhead.py --out benchmarks/results/optuna_overhead.jsonl

20 parameters, images of 32 x 32, everything in memory, CPU time of this process.  *Core* is the
optimizer with ask and tell of one candidate at a time; *Optuna itself* is a study whose sampler
draws at random; *FIDE beyond both* is the rest of a trial with `FIDESampler`.  `CmaEsSampler`
continues a study filled with trials of its space.  All take turns in blocks of 20 trials, and
numbers are medians over blocks, so that other programs affect all of them alike.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, FloatDistribution
from optuna.samplers import CmaEsSampler, RandomSampler
from rows import append

from fide_adapters.optuna import FIDESampler
from fide_plugins import FIDE

DIM, SIDE = 20, 32
MARKS = (1000, 5000, 20_000)
WINDOW, BLOCK = 400, 20  # trials that are timed, up to each mark
NAMES = [f"x{i}" for i in range(DIM)]
PATTERNS = np.random.default_rng(1).random((DIM, SIDE, SIDE, 3), np.float32)
Step = Callable[[], None]


def render(x: Any) -> Any:
    """Sum of patterns, weighted by x."""
    image = np.tensordot(np.asarray(x, np.float32), PATTERNS, 1) * (2 / DIM) - 0.5
    return np.clip(image, 0.0, 1.0)


TARGET = render(np.random.default_rng(0).random(DIM))


def study_step(study: optuna.Study, judge: Callable[[optuna.Trial, Any], float]) -> None:
    """One trial."""
    trial = study.ask()
    x = [trial.suggest_float(name, 0, 1) for name in NAMES]
    study.tell(trial, judge(trial, x))


def sphere(trial: optuna.Trial, x: list[float]) -> float:
    """Loss without an image."""
    return float(np.square(np.array(x) - 0.3).sum())


def fide() -> Step:
    """A trial with FIDESampler, and its image."""
    sampler = FIDESampler(TARGET, seed=0)
    study = optuna.create_study(sampler=sampler)
    return partial(study_step, study, lambda trial, x: sampler.tell_image(trial, render(x)))


def core() -> Step:
    """A candidate of the optimizer, and its image."""
    optimizer = FIDE(DIM, TARGET, seed=0)

    def step() -> None:
        x = optimizer.ask(1)
        optimizer.tell(x, render(x[0])[None])

    return step


def at_random() -> Step:
    """A trial of Optuna's RandomSampler."""
    return partial(study_step, optuna.create_study(sampler=RandomSampler(seed=0)), sphere)


def cma(trials: int) -> Step:
    """A trial of CmaEsSampler where a study has so many trials."""
    space: dict[str, BaseDistribution] = {name: FloatDistribution(0, 1) for name in NAMES}
    study = optuna.create_study(sampler=CmaEsSampler(seed=0))
    study.add_trials(
        [
            optuna.create_trial(
                params=dict(zip(NAMES, x.tolist(), strict=True)),
                distributions=space,
                value=float(x.sum()),
            )
            for x in np.random.default_rng(0).random((trials, DIM))
        ]
    )
    return partial(study_step, study, sphere)


def milliseconds(steps: dict[str, Step]) -> dict[str, float]:
    """CPU time of a step of each, the median of blocks; all go on by a window."""
    times: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(WINDOW // BLOCK):
        for name, step in steps.items():
            start = time.process_time()
            for _ in range(BLOCK):
                step()
            times[name].append(1000 * (time.process_time() - start) / BLOCK)
    return {name: float(np.median(found)) for name, found in times.items()}


def measure() -> dict[str, list[float]]:
    """Milliseconds at the marks, by name."""
    steps = {"fide": fide(), "core": core(), "optuna": at_random()}
    done = 0
    found: dict[str, list[float]] = {}
    for mark in MARKS:
        for _ in range(mark - WINDOW - done):
            for step in steps.values():
                step()
        done = mark
        others = {"drawing": lambda: render(np.zeros(DIM)), "cma": cma(mark - WINDOW)}
        for name, ms in milliseconds({**steps, **others}).items():
            found.setdefault(name, []).append(ms)
    return found


def table(found: dict[str, list[float]]) -> str:
    """What was measured, and what is left of it, as Markdown."""
    ms = {name: np.array(values) for name, values in found.items()}
    whole, alone = ms["fide"] - ms["drawing"], ms["core"] - ms["drawing"]
    rows = {
        "FIDESampler, whole trial": whole,
        "core": alone,
        "Optuna itself": ms["optuna"],
        "FIDE beyond both": whole - alone - ms["optuna"],
        "CmaEsSampler, whole trial": ms["cma"],
        "CmaEsSampler beyond Optuna": ms["cma"] - ms["optuna"],
    }
    head = "| ms a trial | " + " | ".join(f"at {mark:,}" for mark in MARKS) + " |"
    lines = [f"| {n} | " + " | ".join(f"{v:.2f}" for v in row) + " |" for n, row in rows.items()]
    return "\n".join([head, "|---|" + "---|" * len(MARKS), *lines])


def main() -> None:
    """Measure, print the table, and add a line to the results."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    found = measure()
    print(table(found))
    if arguments.out:
        append(arguments.out, found)


if __name__ == "__main__":
    main()
