"""Finds the numbers of a procedural material: FIDE against Markov chains.

    python benchmarks/material.py --table      # without --table: measure what is missing

In VLMaterial (arXiv 2501.18623) a language model writes a material's program, a Markov chain finds
its numbers.  Here the material is a brick wall of ten numbers in NumPy.  The chains are rebuilt:
Gaussian steps, accepted where the loss falls, else with probability exp(-rise / temperature)
("metropolis") or 0.05, as in VLMaterial's program ("constant"); step and temperature are the best
of a grid on ten other targets.  FIDE is `fit` with its defaults; all minimize the MSE.  The guess
is wrong by 0.2 in each number; FIDE has sigma0=0.2.  Solved: all numbers within 0.05.
"""

from __future__ import annotations

import os
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from rows import Row, by_key, command

from fide_plugins import fit
from fide_plugins.types import Float64

RESULTS = Path(__file__).parent / "results" / "material.jsonl"
DIM, SIZE, TARGETS, OTHERS = 10, 64, range(10), range(100, 110)
RENDERS, STARTS, METHODS = (100, 500), ("guess", "none"), ("fide", "metropolis", "constant")
NAMES = "method", "start", "renders", "target"
STEPS, TEMPERATURES = (0.005, 0.01, 0.02, 0.04, 0.08), (1e-6, 1e-5, 1e-4, 1e-3)
STAINS = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 2, (SIZE, SIZE)), (0, 0), 2)


def render(x: Float64) -> Float64:
    """Brick wall (64, 64, 3) of rows, joint, turn, stains and two colors, in [0, 1]."""
    rows, joint, turn, stains = np.array([3, 0.05, -0.5, 0]) + x[:4] * [5, 0.25, 1, 0.6]
    down, across = (np.mgrid[:SIZE, :SIZE] + 0.5) / SIZE - 0.5
    v = rows * (down * np.cos(turn) - across * np.sin(turn))
    u = rows / 2 * (across * np.cos(turn) + down * np.sin(turn)) + np.floor(v) % 2 / 2
    to_edge = np.minimum(0.5 - np.abs(v % 1 - 0.5), 2 * (0.5 - np.abs(u % 1 - 0.5)))
    brick = np.clip((to_edge - joint / 2) * SIZE / rows + 0.5, 0, 1)[..., None]
    image: Float64 = brick * x[4:7] * (1 + stains * STAINS[..., None]) + (1 - brick) * x[7:]
    return image.clip(0, 1)


def problem(number: int, start: str) -> tuple[Float64, Float64]:
    """The numbers of a target, and where a chain starts."""
    rng = np.random.default_rng(number)
    truth, off = rng.random(DIM), rng.choice([-0.2, 0.2], DIM)
    off[(truth + off < 0) | (truth + off > 1)] *= -1
    return truth, truth + off if start == "guess" else rng.random(DIM)


def chain(number: int, start: str, renders: int, step: float, heat: float | None) -> Float64:
    """Best point of a Markov chain; heat: the temperature, None accepts one of 20 worse steps."""
    truth, x = problem(number, start)
    target, rng = render(truth), np.random.default_rng((number, 1))
    best = now = (np.inf, x)
    for _ in range(renders):
        loss = float(np.square(render(x) - target).mean())
        worse = np.exp(min(0, now[0] - loss) / heat) if heat else 0.05
        if loss < now[0] or rng.random() < worse:
            now = (loss, x)
        best = min(best, now, key=lambda each: each[0])
        x = 1 - np.abs(1 - np.abs(rng.normal(now[1], step)) % 2)  # reflected at 0 and 1
    return best[1]


def judged(number: int, x: Float64) -> Row:
    """How good an answer is."""
    truth, _ = problem(number, "guess")
    error = float(np.square(render(x) - render(truth)).mean())
    return {"solved": bool(np.abs(x - truth).max() <= 0.05), "error": error}


@cache
def tune(method: str, start: str, renders: int) -> tuple[float, float | None]:
    """Step and temperature that solve most other targets, then of the lowest median error."""
    scores = {}
    for setting in product(STEPS, TEMPERATURES if method == "metropolis" else [None]):
        found = [judged(n, chain(n, start, renders, *setting)) for n in OTHERS]
        scores[setting] = (-sum(r["solved"] for r in found), np.median([r["error"] for r in found]))
    return min(scores, key=lambda setting: scores[setting])


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    return tuple(row[name] for name in NAMES)


def measure(run: Row) -> Row:
    """The answer of a run."""
    method, start, renders, number = key(run)
    truth, x = problem(number, start)
    if method != "fide":
        setting = tune(method, start, renders)
        x = chain(number, start, renders, *setting)
        return {**run, "setting": setting, **judged(number, x)}
    guess: dict[str, Any] = {"x0": x, "sigma0": 0.2} if start == "guess" else {}
    result = fit(render, render(truth), DIM, renders, workers=0, seed=number, **guess)
    return {**run, **judged(number, result.solutions[0].x)}


def table(rows: list[Row]) -> str:
    """Solved targets and median errors."""
    found, lines = by_key(rows, key), ["| | start | renders | solved | error |", "|---" * 5 + "|"]
    for values in product(METHODS, STARTS, RENDERS):
        each = [found[(*values, n)] for n in TARGETS]
        solved, median = sum(r["solved"] for r in each), np.median([r["error"] for r in each])
        lines.append(f"| {' | '.join(map(str, values))} | {solved} | {median:.2g} |")
    return "\n".join(lines)


if __name__ == "__main__":
    runs = (dict(zip(NAMES, v, strict=True)) for v in product(METHODS, STARTS, RENDERS, TARGETS))
    command(__doc__ or "", runs, measure, RESULTS, key, table)
