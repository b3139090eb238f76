"""Scenes of `intervals.py` in which only the target has noise, as a photograph has.

*waves*: 32 x 32, a sum of three cosines around 0.5, linear in its parameters; noise 0.02, asked for
in generations.  *disc*: 48 x 48, a disc with a soft edge; noise 0.1, clipped to [0, 1], fitted by
`fit`.  In color each of the three channels has its own noise; in gray there is one.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from rows import Row

from fide_plugins import FIDE, Float, Solution, Space, fit
from fide_plugins.types import Float64

__all__ = ["FEATURES", "RUNS", "cells", "run", "table"]

FEATURES = {"waves": ("patch", "dense"), "disc": ("default",)}  # of each scene
COLORS = (3, 1)  # 1: gray
RENDERS = (200, 600, 2000)
RUNS = 10  # targets of each
QUANTILE = 1.6449  # of the normal law: 90 % lie within
NOISE = {"waves": 0.02, "disc": 0.1}

_Y, _X = np.mgrid[0:32, 0:32] / 31
_WAVES = np.array(
    [
        height * np.cos(np.pi * k * _X) * np.cos(np.pi * _Y)
        for k, height in enumerate((0.1, 0.075, 0.05))
    ]
)
_DISC = Space(x=Float(0, 1), y=Float(0, 1), radius=Float(0.05, 0.4))


def cells(scene: str, seeds: range) -> Iterator[Row]:
    """All runs of a scene."""
    for seed in seeds:
        for features in FEATURES[scene]:
            for colors in COLORS:
                for renders in RENDERS:
                    yield {
                        "scene": scene,
                        "seed": seed,
                        "colors": colors,
                        "features": features,
                        "renders": renders,
                    }


def run(cell: Row) -> Row:
    """One row."""
    rng = np.random.default_rng((cell["seed"], 78))
    solve = _waves if cell["scene"] == "waves" else _disc
    truth, best = solve(cell, rng)
    std = best.std
    return {
        **cell,
        "loss": best.loss,
        "error": np.round(best.x - truth, 8).tolist(),
        "std": None if std is None else np.round(std, 8).tolist(),
    }


def _waves(cell: Row, rng: np.random.Generator) -> tuple[Float64, Solution]:
    """The truth (3,) and the best solution."""
    truth = rng.uniform(0.3, 0.7, 3)

    def render(x: Float64) -> Float64:
        return _colored(0.5 + np.tensordot(x - 0.5, _WAVES, 1), cell["colors"])

    clean = render(truth)
    target = clean + rng.normal(0, NOISE["waves"], clean.shape)
    opt = FIDE(3, target, seed=cell["seed"], encoder=cell["features"])
    while opt.evaluations < cell["renders"]:
        X = opt.ask()
        opt.tell(X, [render(x) for x in X])
    assert opt.best is not None
    return truth, opt.best


def _disc(cell: Row, rng: np.random.Generator) -> tuple[Float64, Solution]:
    """The truth (3,) and the best solution."""
    y, x = np.mgrid[0:48, 0:48] / 47
    truth = {name: rng.uniform(0.3, 0.7) for name in ("x", "y")} | {
        "radius": rng.uniform(0.1, 0.25)
    }

    def render(p: dict[str, float]) -> Float64:
        far = np.hypot(x - p["x"], y - p["y"])
        return _colored(1 / (1 + np.exp(30 * (far - p["radius"]))), cell["colors"])

    clean = render(truth)
    target = np.clip(clean + rng.normal(0, NOISE["disc"], clean.shape), 0, 1)
    found = fit(
        render, target, _DISC, budget=cell["renders"], until="budget", workers=0, seed=cell["seed"]
    )
    assert found.best is not None
    return _DISC.encode(truth), found.best


def _colored(image: Float64, colors: int) -> Float64:
    """(H, W) as it is in gray, (H, W, 3) in color."""
    return image if colors == 1 else np.repeat(image[..., None], colors, axis=2)


def table(rows: list[Row]) -> str:
    """How often the truth is in the interval, and how far away it is in standard deviations."""
    columns = [
        "scene",
        "features",
        "picture",
        "renders",
        "runs",
        "truth in the 90 % interval",
        "rms of error / std",
        "median std / abs(error)",
    ]
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    cases = [(s, f, c, n) for s in FEATURES for f in FEATURES[s] for c in COLORS for n in RENDERS]
    for case in cases:
        own = [row for row in rows if _case(row) == case]
        known = [row for row in own if row["std"] is not None]
        if not known:
            continue
        error, std = (np.abs([row[what] for row in known]) for what in ("error", "std"))
        scene, features, colors, renders = case
        words = [scene, features, "gray" if colors == 1 else "color", f"{renders:,}"]
        words += [f"{len(known)} of {len(own)} known", f"{np.mean(error <= QUANTILE * std):.0%}"]
        words += [f"{np.sqrt(np.square(error / std).mean()):.2f}"]
        words += [f"{np.median(std / np.maximum(error, 1e-9)):.1f}"]
        lines.append(f"| {' | '.join(words)} |")
    return "\n".join(lines)


def _case(row: Row) -> tuple[object, ...]:
    return tuple(row.get(name) for name in ("scene", "features", "colors", "renders"))
