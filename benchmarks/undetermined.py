"""Which parameters `Solution.undetermined` names, where it is known which ones the picture shows.

    python benchmarks/undetermined.py --seeds 100-109
    python benchmarks/undetermined.py floats --seeds 100-109

Scenes: *mixed*, of which paper, pages and back change nothing; *floats*, numbers only, of which n
and m change nothing.  Candidates are asked for in generations (`ask`), or one at a time with
Gauss-Newton steps between them (`fit`).  With noise, target and renders have independent Gaussian
noise of this standard deviation.
"""

from __future__ import annotations

import argparse
import os
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from fide_plugins import FIDE, Choice, Float, Int, Solution, Space, fit

V, U = np.mgrid[-1:1:16j, -1:1:16j]
TIGHT = 0.1  # standard deviation below which a number looks determined


class Scene(NamedTuple):
    """Its parameters, those that change nothing, and (way, renders) of each case."""

    space: Space
    blind: frozenset[str]
    cases: tuple[tuple[str, int], ...]


SCENES = {
    "mixed": Scene(
        Space(
            x=Float(-0.7, 0.7), y=Float(-0.7, 0.7), gray=Float(0.1, 1),
            shape=Choice("disk", "square", "ring"), paper=Choice("a4", "a5", "a6"), rows=Int(1, 4),
            pages=Int(1, 4), back=Choice("left", "right"),
        ),
        frozenset({"paper", "pages", "back"}),
        (("ask", 800), ("fit", 800)),
    ),
    "floats": Scene(
        Space(
            x=Float(-0.7, 0.7), y=Float(-0.7, 0.7), gray=Float(0.1, 1),
            n=Float(-5, 5), m=Float(0, 1),
        ),
        frozenset({"n", "m"}),
        (("ask", 400), ("fit", 100), ("fit", 400), ("fit", 800)),
    ),
}  # fmt: skip


def render(p: dict[str, Any], noise: float, rng: np.random.Generator) -> Any:
    p = {"shape": "disk", "rows": 1, **p}
    far = U - p["x"], V - p["y"]
    round_, square = np.hypot(*far), np.abs(far).max(axis=0)
    reach = {"disk": round_, "square": square, "ring": abs(round_ - 0.25) + 0.3}[p["shape"]]
    inside = 1 / (1 + np.exp(20 * (reach - 0.5)))
    image = inside * p["gray"] + (1 - inside) * (0.25 + 0.2 * np.cos(np.pi * p["rows"] * V))
    if noise:
        image = np.clip(image + noise * rng.normal(size=V.shape), 0, 1)
    return np.repeat(image[..., None], 3, axis=2)


def solved(scene: Scene, way: str, renders: int, seed: int, noise: float) -> Solution:
    """Best solution of one run."""
    rng = np.random.default_rng(seed)
    space = scene.space
    target = render(space.decode(rng.random(space.dim)), noise, rng)
    if way == "fit":

        def one(p: dict[str, Any]) -> Any:
            return render(p, noise, rng)

        best = fit(one, target, space, budget=renders, until="budget", workers=0, seed=seed).best
    else:
        opt = FIDE(space, target, seed=seed)
        while opt.evaluations < renders:
            X = opt.ask()
            opt.tell(X, [render(space.decode(x), noise, rng) for x in X])
        best = opt.best
    assert best is not None
    return best


def line(name: str, way: str, renders: int, noise: float, seeds: range) -> str:
    """A row of the table, in Markdown."""
    scene = SCENES[name]
    space, blind = scene.space, scene.blind
    shown = set(space.parameters) - blind
    found = [solved(scene, way, renders, seed, noise) for seed in seeds]
    named = [set(one.undetermined) for one in found]
    rights, wrongs = (sum(len(one & names) for one in named) for names in (blind, shown))
    axes = [axis for one in blind for axis in space.axes[one]]
    stds = np.array([one.std[axes] for one in found if one.std is not None])
    numbers = stds[~np.isnan(stds)]
    tight = f"{(numbers < TIGHT).sum()} of {numbers.size}" if numbers.size else "-"
    return (
        f"| {name} | {way} | {renders} | {noise} | {rights} of {len(blind) * len(found)} | {tight} "
        f"| {wrongs} of {len(shown) * len(found)} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(SCENES))
    parser.add_argument("--seeds", default="0-9")
    arguments = parser.parse_args()
    first, last = map(int, arguments.seeds.split("-"))
    columns = ["scene", "asked by", "renders", "noise", "named, of those that do not show"]
    columns += [f"std below {TIGHT}, of these numbers", "named, of those that show"]
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    for name in arguments.scenes or SCENES:
        for way, renders in SCENES[name].cases:
            for noise in (0.0, 0.02):
                print(line(name, way, renders, noise, range(first, last + 1)), flush=True)


if __name__ == "__main__":
    main()
