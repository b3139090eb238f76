"""The next picture with a learned model: `FIDE.retarget`, with and without it, and new searches.

    python benchmarks/retarget_learned.py
    python benchmarks/retarget_learned.py --table

Scenes of a gray disk on black, 16 x 16 pixels: of a hard edge (its place and radius), of a soft one
(its place and gray), and two of a hard edge (place, radius and gray of each).  The first picture is
searched until its loss is the goal.  The second is anywhere (`far`), or each of its parameters
differs by 2 % of the box (`near`).  Counted are the renders of the second one to the goal:

model    `retarget` of a run that began with the model
loaded   the same run saved and loaded, after which it has no model
new      a new search with the model
never    `retarget` of a run that never had a model

Every pair of pictures is a line of the file `--out` for each of these; a second call does what is
missing.  Each model is learned once a call, and is the same each time.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rows import Row, command

from fide_plugins import FIDE, Float, Group, Space, learn
from fide_plugins.learning import Model
from fide_plugins.space.space import Params
from fide_plugins.types import Float64

RESULTS = Path(__file__).parent / "results" / "retarget_learned.jsonl"
SIDE = 16
GRID = (np.arange(SIDE) + 0.5) / SIDE
NEAR = 0.02  # of the box
MOST = 3000  # renders of a picture
PAIRS = 12  # of pictures
WAYS = ("model", "loaded", "new", "never")


def disk(x: float, y: float, radius: float, edge: float) -> Float64:
    """Share (H, W) of each pixel inside a disk; edge: its width in pixels."""
    distance = np.hypot(GRID[None] - x, GRID[:, None] - y)
    inside: Float64 = np.clip((radius - distance) * SIDE / edge + 0.5, 0, 1)
    return inside


def hard(params: Params) -> Float64:
    """One disk of a hard edge."""
    return disk(params["x"], params["y"], 0.05 + 0.25 * params["radius"], 1)


def soft(params: Params) -> Float64:
    """One disk of a soft edge."""
    image: Float64 = (0.2 + 0.8 * params["gray"]) * disk(params["x"], params["y"], 0.25, 6)
    return image


def two(params: Params) -> Float64:
    """Two disks, the second before the first."""
    image = np.zeros((SIDE, SIDE))
    for one in (params["first"], params["second"]):
        inside = disk(one["x"], one["y"], 0.05 + 0.25 * one["radius"], 1)
        image += inside * (0.2 + 0.8 * one["gray"] - image)
    return image


def unit(*names: str) -> dict[str, Float]:
    """Parameters in [0, 1]."""
    return {name: Float(0, 1) for name in names}


@dataclass(frozen=True)
class Scene:
    """A renderer, its space, the renders of its model, and the goal."""

    render: Callable[[Params], Float64]
    space: Space
    renders: int
    goal: float


ONE_OF_TWO = Group(**unit("x", "y", "radius", "gray"))
SCENES = {
    "hard": Scene(hard, Space(**unit("x", "y", "radius")), 1200, 1e-4),
    "soft": Scene(soft, Space(**unit("x", "y", "gray")), 1200, 1e-4),
    "two": Scene(two, Space(first=ONE_OF_TWO, second=ONE_OF_TWO), 6000, 1e-5),
}


@cache
def model_of(name: str) -> Model:
    """The model of a scene."""
    scene = SCENES[name]
    return learn(
        scene.render, scene.space, renders=scene.renders, size=SIDE, passes=6, seed=0, workers=0
    )


def search(opt: FIDE, scene: Scene) -> int:
    """Renders until the loss is at most the goal, at most `MOST`."""
    before = opt.evaluations
    while opt.evaluations - before < MOST:
        X = opt.ask()
        opt.tell(X, [scene.render(scene.space.decode(x)) for x in X])
        if opt.best is not None and opt.best.loss <= scene.goal:
            break
    return opt.evaluations - before


def measure(run: Row) -> Row:
    """Renders of the second picture of a pair."""
    name, how, seed, way = key(run)
    return {**run, "renders": renders_of(name, how, seed, way)}


def renders_of(name: str, how: str, seed: int, way: str) -> int:
    """Renders of a run, by what makes it."""
    scene, rng = SCENES[name], np.random.default_rng(seed)
    first = rng.uniform(0.1, 0.9, scene.space.dim)
    sign = rng.choice((-1, 1), scene.space.dim)
    second = first + NEAR * sign if how == "near" else rng.uniform(0.1, 0.9, scene.space.dim)
    before, after = (scene.render(scene.space.decode(x)) for x in (first, second))
    model = None if way == "never" else model_of(name)
    if way == "new":
        return search(FIDE(scene.space, after, seed=seed, learned=model), scene)
    opt = FIDE(scene.space, before, seed=seed, learned=model)
    search(opt, scene)
    if way == "loaded":
        with tempfile.TemporaryDirectory() as folder:
            opt.save(Path(folder) / "run")
            opt = FIDE.load(Path(folder) / "run")
    opt.retarget(after)
    return search(opt, scene)


def planned() -> Iterator[Row]:
    """All runs."""
    for name in SCENES:
        for how in ("far", "near"):
            for seed in range(PAIRS):
                for way in WAYS:
                    yield {"scene": name, "second": how, "seed": seed, "way": way}


def key(row: Row) -> tuple[str, str, int, str]:
    """What makes a run."""
    return row["scene"], row["second"], row["seed"], row["way"]


def table(rows: list[Row]) -> str:
    """Geometric means of the renders, and in how many pairs the model helped, in Markdown."""
    lines = [
        f"| scene, goal | second picture | pairs | {' | '.join(WAYS)} | model < loaded |",
        "|---|---|---:|" + "---:|" * (len(WAYS) + 1),
    ]
    found = {key(row): row["renders"] for row in rows}
    for name, scene in SCENES.items():
        for how in ("far", "near"):
            of = {way: [found[name, how, s, way] for s in range(PAIRS)] for way in WAYS}
            means = " | ".join(f"{np.exp(np.log(of[way]).mean()):.0f}" for way in WAYS)
            pairs = list(zip(of["model"], of["loaded"], strict=True))
            fewer, more = sum(a < b for a, b in pairs), sum(a > b for a, b in pairs)
            lines.append(
                f"| {name}, {scene.goal:g} | {how} | {PAIRS} | {means} "
                f"| {fewer} of {fewer + more} that differ |"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    command(__doc__ or "", planned(), measure, RESULTS, key, table)
