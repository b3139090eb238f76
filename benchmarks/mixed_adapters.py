"""Integers, choices, floats and logarithms in `fit`, Optuna and Nevergrad.

    python benchmarks/mixed_adapters.py fit optuna nevergrad --out runs/mixed.jsonl
    python benchmarks/mixed_adapters.py --out benchmarks/results/mixed_adapters.jsonl --table

Three scenes of 32 x 32 pixels, 500 renders a run.  Seed s has its own picture, whose parameters are
drawn at random, and all optimizers look for the same ones.  A picture counts as found when the mean
squared error is below 1e-4.  `--label` is added to the names of optimizers of another version.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rows import append, read, rows_of

Image = npt.NDArray[np.float64]
Params = dict[str, Any]
Ranges = Mapping[str, tuple[Any, ...]]

BUDGET, FOUND, SIDE = 500, 1e-4, 32
GRID = (np.arange(SIDE) + 0.5) / SIDE
X, Y = GRID[None, :], GRID[:, None]
INK = {
    "red": (0.9, 0.2, 0.2),
    "green": (0.2, 0.8, 0.3),
    "blue": (0.2, 0.3, 0.9),
    "gray": (0.6,) * 3,
}


def inside(distance: Image, width: float) -> Image:
    """Coverage of pixels at a signed distance from an outline, which is so wide."""
    covered: Image = 1 / (1 + np.exp(np.clip(distance / width, -50, 50)))
    return covered


def wall(p: Params) -> Image:
    """A wall of tiles: their number, pattern, joints and color."""
    u, v = X * p["columns"] + p["shift"], Y * p["rows"]
    if p["pattern"] == "bricks":
        u = u + 0.5 * (np.floor(v) % 2)
    elif p["pattern"] == "slanted":
        u = u + 0.5 * v
    near = np.minimum(0.5 - abs(u % 1 - 0.5), 0.5 - abs(v % 1 - 0.5))
    if p["pattern"] == "disks":
        near = 0.5 - np.hypot(u % 1 - 0.5, v % 1 - 0.5)
    tile = 1 - inside(near - 0.5 * p["joint"], 0.03)
    image: Image = p["light"] * tile[..., None] * np.array(INK[p["color"]])
    return image


def flower(p: Params) -> Image:
    """A flower: number and shape of its petals, place, size and colors."""
    dx, dy = X - p["x"], Y - p["y"]
    wave = np.cos(p["petals"] * np.arctan2(dy, dx) + p["turn"])
    if p["shape"] == "star":
        wave = 1 - 2 * np.sqrt(np.clip((1 - wave) / 2, 0, 1))
    elif p["shape"] == "gear":
        wave = np.tanh(5 * wave)
    petal = inside(np.hypot(dx, dy) - p["size"] * (1 + 0.35 * wave), 0.02)[..., None]
    sky = np.array([0.1, 0.1, 0.1]) + 0.12 * p["sky"]
    image: Image = petal * np.array(INK[p["color"]]) * p["light"] + (1 - petal) * sky
    return image


def shelf(p: Params) -> Image:
    """Two things on a shelf: what each one is, its shade, place and size."""
    image = np.full((SIDE, SIDE), 0.1)
    for i in range(2):
        dx, dy, size = X - p[f"x{i}"], Y - p[f"y{i}"], p[f"size{i}"]
        distance = {
            "ball": np.hypot(dx, dy) - size,
            "box": np.maximum(abs(dx), abs(dy)) - 0.9 * size,
            "cone": np.maximum(abs(dx) * 0.9 + 0.45 * (dy - size), -dy - size) - 0.3 * size,
        }[p[f"kind{i}"]]
        shape = inside(distance, 0.02)
        image = (1 - shape) * image + shape * (0.3 + 0.1 * p[f"shade{i}"])
    return np.repeat(image[..., None], 3, axis=2)


SCENES: dict[str, tuple[Callable[[Params], Image], Ranges]] = {
    "wall": (
        wall,
        {
            "color": ("choice", *INK),
            "columns": ("int", 2, 9),
            "joint": ("log", 0.02, 0.5),
            "light": ("float", 0.3, 1.0),
            "pattern": ("choice", "grid", "bricks", "slanted", "disks"),
            "rows": ("int", 2, 9),
            "shift": ("float", 0.0, 0.5),
        },
    ),
    "flower": (
        flower,
        {
            "color": ("choice", *INK),
            "light": ("float", 0.5, 1.0),
            "petals": ("int", 2, 9),
            "shape": ("choice", "round", "star", "gear"),
            "size": ("log", 0.08, 0.4),
            "sky": ("int", 0, 5),
            "turn": ("float", 0.0, 6.28),
            "x": ("float", 0.2, 0.8),
            "y": ("float", 0.2, 0.8),
        },
    ),
    "shelf": (
        shelf,
        {
            **{f"kind{i}": ("choice", "ball", "box", "cone") for i in range(2)},
            **{f"shade{i}": ("int", 0, 6) for i in range(2)},
            **{f"size{i}": ("log", 0.05, 0.2) for i in range(2)},
            **{f"x{i}": ("float", 0.1, 0.9) for i in range(2)},
            **{f"y{i}": ("float", 0.1, 0.9) for i in range(2)},
        },
    ),
}


def answer(ranges: Ranges, seed: int) -> Params:
    """Parameters of the picture of a seed."""
    rng = np.random.default_rng((seed, 77))
    drawn: Params = {}
    for name, (kind, *given) in ranges.items():
        if kind == "choice":
            drawn[name] = given[rng.integers(len(given))]
        elif kind == "int":
            drawn[name] = int(rng.integers(given[0], given[1] + 1))
        else:
            low, high = np.log(given) if kind == "log" else given
            value = rng.uniform(low, high)
            drawn[name] = float(np.exp(value) if kind == "log" else value)
    return drawn


# -- optimizers ------------------------------------------------------------------------------------

Draw = Callable[[Params], Image]


def by_fit(draw: Draw, ranges: Ranges, target: Image, seed: int) -> None:
    """The renders of `fit`."""
    from fide_plugins import Choice, Float, Int, Space, fit

    made: dict[str, Callable[..., Any]] = {
        "choice": Choice,
        "int": Int,
        "float": Float,
        "log": lambda low, high: Float(low, high, log=True),
    }
    space = Space({name: made[kind](*given) for name, (kind, *given) in ranges.items()})
    fit(draw, target, space, budget=BUDGET, workers=0, seed=seed)


def by_optuna(draw: Draw, ranges: Ranges, target: Image, seed: int) -> None:
    """The renders of a study with FIDESampler."""
    import optuna

    from fide_adapters.optuna import FIDESampler, image_objective

    optuna.logging.set_verbosity(optuna.logging.ERROR)

    def suggest(trial: optuna.Trial) -> Image:
        made: dict[str, Callable[..., Any]] = {
            "choice": lambda name, *values: trial.suggest_categorical(name, values),
            "int": trial.suggest_int,
            "float": trial.suggest_float,
            "log": lambda name, low, high: trial.suggest_float(name, low, high, log=True),
        }
        return draw({name: made[kind](name, *given) for name, (kind, *given) in ranges.items()})

    study = optuna.create_study(sampler=FIDESampler(target=target, seed=seed))
    study.optimize(image_objective(suggest), n_trials=BUDGET)


def by_nevergrad(draw: Draw, ranges: Ranges, target: Image, seed: int) -> None:
    """The renders of Nevergrad's `minimize` with FIDE."""
    import nevergrad as ng

    from fide_adapters.nevergrad import ParametrizedFIDE

    made: dict[str, Callable[..., Any]] = {
        "choice": lambda *values: ng.p.Choice(list(values)),
        "int": lambda low, high: ng.p.Scalar(lower=low, upper=high).set_integer_casting(),
        "float": lambda low, high: ng.p.Scalar(lower=low, upper=high),
        "log": lambda low, high: ng.p.Log(lower=low, upper=high),
    }
    space = ng.p.Dict(**{name: made[kind](*given) for name, (kind, *given) in ranges.items()})
    space.random_state.seed(seed)
    ParametrizedFIDE(target=target, seed=seed)(space, budget=BUDGET).minimize(draw)


OPTIMIZERS = {"fit": by_fit, "optuna": by_optuna, "nevergrad": by_nevergrad}


def measure(scene: str, optimizer: str, seed: int) -> dict[str, Any]:
    """One run."""
    draw, ranges = SCENES[scene]
    target = np.clip(draw(answer(ranges, seed)), 0, 1)
    losses: list[float] = []

    def render(params: Params) -> Image:
        image = np.clip(draw(params), 0, 1)
        losses.append(float(((image - target) ** 2).mean()))
        return image

    start = time.process_time()
    OPTIMIZERS[optimizer](render, ranges, target, seed)
    curve = np.minimum.accumulate(losses)[:BUDGET]
    solved = np.flatnonzero(curve < FOUND)
    return {
        "scene": scene,
        "seed": seed,
        "best": float(curve[-1]),
        "found_at": int(solved[0]) + 1 if len(solved) else None,
        "cpu_s": round(time.process_time() - start, 2),
    }


def table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Pictures found, by optimizer and scene, as Markdown."""
    names = list(dict.fromkeys(row["optimizer"] for row in rows))
    yield f"| found by {BUDGET} renders | {' | '.join(SCENES)} |"
    yield "|---" * (len(SCENES) + 1) + "|"
    for name in names:
        own = [[r for r in rows if (r["optimizer"], r["scene"]) == (name, s)] for s in SCENES]
        cells = (f"{sum(r['found_at'] is not None for r in of)} of {len(of)}" for of in own)
        yield f"| {name} | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("optimizers", nargs="*", choices=[[], *OPTIMIZERS])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--label", default="", help="of another version, such as ' before'")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    done = {(r["scene"], r["optimizer"], r["seed"]) for r in rows_of(arguments.out)}
    for seed in range(arguments.seeds):
        for scene in SCENES:
            for optimizer in arguments.optimizers:
                name = optimizer + arguments.label
                if (scene, name, seed) not in done:
                    append(arguments.out, {"optimizer": name, **measure(scene, optimizer, seed)})
    if arguments.table:
        print("\n".join(table(read(arguments.out))))


if __name__ == "__main__":
    main()
