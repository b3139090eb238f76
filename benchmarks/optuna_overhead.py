"""Time of a trial beyond rendering, with Optuna and without, up to trial 20,000.

    python benchmarks/optuna_overhead.py --out benchmarks/results/optuna_overhead.jsonl
    python benchmarks/optuna_overhead.py --sqlite --marks 1000

20 parameters, images of 32 x 32, studies in memory or in files of SQLite, CPU time of this process.
*Core* is the optimizer that is asked for whole generations, as the sampler asks, and told one
candidate at a time; *Optuna itself* is a study whose sampler draws at random; *FIDE beyond both* is
the rest of a trial with `FIDESampler`.  `CmaEsSampler` continues a study filled with trials of its
space.  All take turns in blocks of 20 trials, and numbers are medians over blocks, so that other
programs affect all of them alike.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, FloatDistribution
from optuna.samplers import BaseSampler, CmaEsSampler, RandomSampler
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


def new_study(sampler: BaseSampler, folder: str | None) -> optuna.Study:
    """A study in a new file in the folder; None: in memory."""
    storage = None if folder is None else f"sqlite:///{folder}/{uuid4().hex}.db"
    return optuna.create_study(storage=storage, sampler=sampler)


def fide(folder: str | None) -> Step:
    """A trial with FIDESampler, and its image."""
    sampler = FIDESampler(TARGET, seed=0)
    study = new_study(sampler, folder)
    return partial(study_step, study, lambda trial, x: sampler.tell_image(trial, render(x)))


def core() -> Step:
    """A candidate of the optimizer, and its image."""
    optimizer = FIDE(DIM, TARGET, seed=0)
    asked: list[Any] = []

    def step() -> None:
        if not asked:
            asked.extend(reversed(optimizer.ask()))
        x = asked.pop()
        optimizer.tell(x[None], render(x)[None])

    return step


def at_random(folder: str | None) -> Step:
    """A trial of Optuna's RandomSampler."""
    return partial(study_step, new_study(RandomSampler(seed=0), folder), sphere)


def cma(trials: int, folder: str | None) -> Step:
    """A trial of CmaEsSampler where a study has so many trials."""
    space: dict[str, BaseDistribution] = {name: FloatDistribution(0, 1) for name in NAMES}
    study = new_study(CmaEsSampler(seed=0), folder)
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


def measure(marks: list[int], folder: str | None) -> dict[str, list[float]]:
    """Milliseconds at the marks, by name; studies are in files in the folder, or in memory."""
    steps = {"fide": fide(folder), "core": core(), "optuna": at_random(folder)}
    done = 0
    found: dict[str, list[float]] = {}
    for mark in marks:
        for _ in range(mark - WINDOW - done):
            for step in steps.values():
                step()
        done = mark
        others = {"drawing": lambda: render(np.zeros(DIM)), "cma": cma(mark - WINDOW, folder)}
        for name, ms in milliseconds({**steps, **others}).items():
            found.setdefault(name, []).append(ms)
    return found


def table(found: dict[str, list[float]], marks: list[int]) -> str:
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
    head = "| ms a trial | " + " | ".join(f"at {mark:,}" for mark in marks) + " |"
    lines = [f"| {n} | " + " | ".join(f"{v:.2f}" for v in row) + " |" for n, row in rows.items()]
    return "\n".join([head, "|---|" + "---|" * len(marks), *lines])


def main() -> None:
    """Measure, print the table, and add a line to the results."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--sqlite", action="store_true", help="studies in files, not in memory")
    parser.add_argument(
        "--marks", type=int, nargs="+", default=MARKS, help=f"trials, from {WINDOW} on"
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = measure(arguments.marks, folder if arguments.sqlite else None)
    print(table(found, arguments.marks))
    if arguments.out:
        append(arguments.out, {"sqlite": arguments.sqlite, "marks": list(arguments.marks), **found})


if __name__ == "__main__":
    main()
