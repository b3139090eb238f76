"""What a trial costs beyond rendering, in Optuna and without, up to trial 20,000.

    python benchmarks/optuna_overhead.py --out benchmarks/results/optuna_overhead.jsonl
    python benchmarks/optuna_overhead.py --table benchmarks/results/optuna_overhead.jsonl

20 parameters, images of 32 x 32, everything in memory, processor time of this process.  *Core* is
the optimizer asked and told one candidate at a time; *Optuna itself* is a study whose sampler draws
at random; *FIDE beyond both* is what is left of a trial with `FIDESampler`.  `CmaEsSampler` is
measured on studies that were filled with trials of its space, and continued.  A second call does
what is missing.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import optuna
from optuna.distributions import FloatDistribution
from optuna.samplers import CmaEsSampler, RandomSampler

from fide_adapters.optuna import FIDESampler
from fide_plugins import FIDE

DIM, SIDE = 20, 32
MARKS = (1000, 5000, 20_000)
WINDOW, BLOCK = 600, 20  # trials that are timed, up to each mark, and of which each time is a mean
NAMES = [f"x{i}" for i in range(DIM)]
PATTERNS = np.random.default_rng(1).random((DIM, SIDE, SIDE, 3), np.float32)


def render(x: Any) -> Any:
    """Sum of patterns, weighted by x."""
    image = np.tensordot(np.asarray(x, np.float32), PATTERNS, 1) * (2 / DIM) - 0.5
    return np.clip(image, 0.0, 1.0)


TARGET = render(np.random.default_rng(0).random(DIM))


def timed(step: Callable[[], None]) -> float:
    """Milliseconds of processor time of a step, the median of blocks in a window.

    So collections of all garbage do not count; they are rare in a heap that is large.
    """
    times = []
    for _ in range(WINDOW // BLOCK):
        start = time.process_time()
        for _ in range(BLOCK):
            step()
        times.append(1000 * (time.process_time() - start) / BLOCK)
    return float(np.median(times))


def at_marks(step: Callable[[], None]) -> list[float]:
    """Milliseconds of a step, in a window that ends at each mark."""
    done, results = 0, []
    for mark in MARKS:
        while done < mark - WINDOW:
            step()
            done += 1
        results.append(timed(step))
        done = mark
    return results


def study_step(study: optuna.Study, judge: Callable[[optuna.Trial, Any], float]) -> None:
    """One trial; rendering is not part of it."""
    trial = study.ask()
    x = [trial.suggest_float(name, 0, 1) for name in NAMES]
    study.tell(trial, judge(trial, x))


def with_fide() -> list[float]:
    """Milliseconds a trial of FIDESampler at the marks, without drawing the image."""
    sampler = FIDESampler(TARGET, seed=0)
    study = optuna.create_study(sampler=sampler)

    def judge(trial: optuna.Trial, x: Any) -> float:
        return sampler.tell_image(trial, render(x))

    return [ms - drawing() for ms in at_marks(partial(study_step, study, judge))]


def drawing() -> float:
    """Milliseconds of an image."""
    return timed(lambda: render(np.zeros(DIM)))


def with_core() -> list[float]:
    """Milliseconds a candidate at the marks."""
    optimizer = FIDE(DIM, TARGET, seed=0)

    def step() -> None:
        x = optimizer.ask(1)
        optimizer.tell(x, render(x[0])[None])

    return [ms - drawing() for ms in at_marks(step)]


def with_random() -> list[float]:
    """Milliseconds a trial of RandomSampler at the marks."""
    study = optuna.create_study(sampler=RandomSampler(seed=0))
    return at_marks(partial(study_step, study, sphere))


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
        results.append(timed(partial(study_step, study, sphere)))
    return results


def sphere(trial: optuna.Trial, x: list[float]) -> float:
    """Loss without an image."""
    return float(np.square(np.array(x) - 0.3).sum())


ROWS: dict[str, Callable[[], list[float]]] = {
    "Optuna itself": with_random,
    "CmaEsSampler": with_cma,
    "core": with_core,
    "FIDESampler": with_fide,
}


def main() -> None:
    """Measure what is missing, or print the table."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--table", type=Path)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    for name, measure in ROWS.items():
        if name not in read(arguments.out):
            line = {"row": name, "ms": measure(), "date": time.strftime("%Y-%m-%d")}
            with arguments.out.open("a") as file:
                file.write(json.dumps(line) + "\n")


def read(path: Path) -> dict[str, list[float]]:
    """Rows of a result file, if there is one."""
    lines = map(json.loads, path.read_text().splitlines()) if path.exists() else ()
    return {line["row"]: line["ms"] for line in lines}


def table(found: dict[str, list[float]]) -> str:
    """What was measured, and what is left of it, as Markdown."""
    fide, core, optuna_itself, cma = (
        np.array(found[name]) for name in ("FIDESampler", "core", "Optuna itself", "CmaEsSampler")
    )
    rows = {
        "FIDESampler, whole trial": fide,
        "core": core,
        "Optuna itself": optuna_itself,
        "FIDE beyond both": fide - core - optuna_itself,
        "CmaEsSampler, whole trial": cma,
        "CmaEsSampler beyond Optuna": cma - optuna_itself,
    }
    head = "| ms a trial | " + " | ".join(f"at {mark:,}" for mark in MARKS) + " |"
    lines = [f"| {n} | " + " | ".join(f"{ms:.2f}" for ms in row) + " |" for n, row in rows.items()]
    return "\n".join([head, "|---|" + "---|" * len(MARKS), *lines])


if __name__ == "__main__":
    main()
