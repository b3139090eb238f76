"""Gradients through the renderer against the search: six beads (paper, its figure of Mitsuba).

    python benchmarks/gradients.py --targets 200-200 --rates 0.003 0.01 0.03 --out runs/rates.jsonl
    python benchmarks/gradients.py
    python benchmarks/gradients.py --check
    python benchmarks/gradients.py --table

Adam descends the mean squared error by the gradients of Mitsuba's `prb_projective` (Zhang, Roussel
and Jakob 2023, doi:10.1145/3618385), without what indirect light adds at silhouettes, whose
sampling takes minutes to prepare here.  Three starts: `center`, where every search of the paper
begins, with all beads in one place; `random` places; and `near`, each coordinate of the truth moved
by at most 5 % of the box.  `fide` has the same scene, loss and number of samples per pixel, and no
gradients.

Beads are of glass, as in the task, or diffuse and white (`diffuse`), to tell what is hard for whom:
`--check` compares gradients with differences of the loss.

Every run (optimizer, material, start, target, rate) is one line of the output file, appended when
it is done; a second call does what is missing.  The last point of a descent is judged, and of the
search the candidate with the lowest loss: by its own picture with 1,024 samples per pixel, and by
how far each bead is from its place, matched as a set.
"""

from __future__ import annotations

import argparse
import itertools
import os
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from learned_beads import apart
from moves import span
from numpy.typing import NDArray
from rows import Row, read, run_missing

from fide_plugins import FIDE
from fide_tasks.beads import _RADIUS as RADIUS, Beads

RESULTS = Path(__file__).parent / "results" / "gradients.jsonl"
STARTS = ("center", "random", "near")
SIZE, SPP = 32, 16
STEPS, RENDERS = 50, 1000
RATES = {"glass": 0.003, "diffuse": 0.01}
"""Of Adam: the best of three on target 200, by the picture that it ends with."""
NEAR = 0.05
MATERIALS = ("glass", "diffuse")
_KIND = ("material", "optimizer", "start", "rate")

Point = NDArray[np.float64]


class MattBeads(Beads):
    """The same beads in the same places, of a diffuse white."""

    def _scene(self, mi: Any) -> dict[str, Any]:
        scene = super()._scene(mi)
        for name in (name for name in scene if name.startswith("bead-")):
            scene[name]["bsdf"] = {"type": "diffuse"}
        return scene


class Descent:
    """Adam on the 18 coordinates in the unit cube; the scene is that of the task."""

    def __init__(self, task: Beads, x: Point, rate: float) -> None:
        import mitsuba as mi

        mi.set_variant(task.variant)
        import drjit as dr

        self._mi, self._dr, self._task = mi, dr, task
        scene = task._scene(mi)
        height, width = task.size
        film = {
            "type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"},
            "pixel_format": "rgb", "component_format": "float32", "sample_border": True,
        }  # fmt: skip
        camera = {**scene["sensor"], "film": film, "sampler": {"type": "independent"}}
        self._scene = mi.load_dict({**scene, "sensor": camera})
        self._integrator = mi.load_dict(
            {"type": "prb_projective", "max_depth": task.max_depth, "sppi": 0, "guiding": "none"}
        )
        self._parameters = mi.traverse(self._scene)
        self._target = mi.TensorXf(np.ascontiguousarray(task.target))
        self.x = torch.tensor(x, dtype=torch.float64)
        self._adam = torch.optim.Adam([self.x], lr=rate)

    def step(self, seed: int) -> float:
        """One step by the gradient at the present point, whose loss is returned."""
        loss, gradient = self.gradient(self.x.numpy(), seed)
        self.x.grad = torch.from_numpy(np.nan_to_num(gradient))
        self._adam.step()
        with torch.no_grad():
            self.x.clamp_(0.0, 1.0)
        return loss

    def gradient(self, x: Point, seed: int) -> tuple[float, Point]:
        """Mean squared error, and its gradient (d,), by other paths than those of the loss."""
        mi, dr = self._mi, self._dr
        low, high = self._box()
        centers = [mi.Point3f(*c) for c in (low + x * (high - low)).reshape(-1, 3).tolist()]
        dr.enable_grad(*centers)
        for i, center in enumerate(centers):
            place = mi.Transform4f().translate(center).scale(RADIUS)
            self._parameters[f"bead-{i}.to_world"] = place
        self._parameters.update()
        radiance = mi.render(
            self._scene, self._parameters, integrator=self._integrator, seed=seed, spp=SPP
        )
        loss = dr.mean(dr.square(srgb(dr, radiance) - self._target), axis=None)
        dr.backward(loss)
        gradient = np.concatenate([np.array(dr.grad(c)).ravel() for c in centers])
        return float(loss.array[0]), gradient.astype(np.float64) * (high - low)

    def _box(self) -> tuple[Point, Point]:
        """Bounds (d,) of the coordinates."""
        parameters = self._task.parameters
        return np.array([p.low for p in parameters]), np.array([p.high for p in parameters])


def srgb(dr: Any, radiance: Any) -> Any:
    """IEC 61966-2-1, as the task encodes its images, differentiable."""
    x = dr.clip(radiance, 0.0, 1.0)
    power = 1.055 * dr.power(dr.maximum(x, 0.0031308), 1 / 2.4) - 0.055
    return dr.select(x <= 0.0031308, 12.92 * x, power)


def begin(kind: str, task: Beads) -> Point:
    """Where a descent begins, (d,)."""
    rng = np.random.default_rng((task.seed, 1))
    assert task.x_star is not None
    if kind == "center":
        return np.full(task.dim, 0.5)
    if kind == "random":
        return rng.random(task.dim)
    return np.clip(task.x_star + rng.uniform(-NEAR, NEAR, task.dim), 0.0, 1.0)


def descend(row: Row) -> Row:
    """One run by gradients."""
    task = make(row["target"], row["material"])
    descent = Descent(task, begin(row["start"], task), row["rate"])
    losses, start = [], time.process_time()
    for step in range(STEPS):
        losses.append(descent.step(step))
        if step == 0:
            start = time.process_time()  # the first one compiles
    seconds = (time.process_time() - start) / (STEPS - 1)
    return judged(task, row, descent.x.numpy(), losses) | {"seconds": round(seconds, 4)}


def search(row: Row) -> Row:
    """One run without gradients."""
    task = make(row["target"], row["material"])
    opt = FIDE(task.space, task.target, loss="mse", seed=row["target"])
    losses, rendering = [], 0.0
    while opt.evaluations < RENDERS:
        before = opt.evaluations
        X = opt.ask()[: RENDERS - before]
        start = time.process_time()
        images = task.render(X, seed=list(range(before, before + len(X))))
        rendering += time.process_time() - start
        opt.tell(X, images)
        assert opt.best is not None
        losses.append(opt.best.loss)
        best = opt.best.x
    found = judged(task, row, best, losses)
    return found | {"seconds": round(rendering / RENDERS, 4)}


def make(target: int, material: str) -> Beads:
    """The scene of a target."""
    kind = MattBeads if material == "diffuse" else Beads
    return kind(SIZE, target, spp=SPP, threads=1)


def check(material: str, target: int = 200, times: int = 16) -> str:
    """Gradient near the truth, and differences of the loss, of some coordinates."""
    task = make(target, material)
    x, axes = begin("near", task), (0, 4, 6)
    descent = Descent(task, x, RATES[material])
    gradients = np.array([descent.gradient(x, seed)[1] for seed in range(times)])
    mean, error = gradients.mean(axis=0), gradients.std(axis=0, ddof=1) / times**0.5
    lines = []
    for axis in axes:
        sides = [x + sign * 0.02 * np.eye(task.dim)[axis] for sign in (1, -1)]
        high, low = (np.square(task.reference(y) - task.target).mean() for y in sides)
        slope = f"{mean[axis]:+.4f} +- {error[axis]:.4f}"
        lines.append(f"| {material} | {axis} | {slope} | {(high - low) / 0.04:+.4f} |")
    return "\n".join(lines)


def judged(task: Beads, row: Row, x: Point, losses: list[float]) -> Row:
    """What a run has found; `error`: MSE of its picture without noise."""
    assert task.x_star is not None
    error = float(np.square(task.reference(x) - task.target).mean())
    return {
        **row,
        "first": losses[0],
        "lowest": min(losses),
        "last": losses[-1],
        "error": error,
        "beads": [round(a, 4) for a in sorted(apart(x, task.x_star).tolist())],
    }


def table(rows: list[Row]) -> str:
    """Medians over targets, and beads that were found, in Markdown."""
    columns = ["beads", "", "start", "targets", "error, median (worst)"]
    columns += ["beads within 0.05", "within 0.1", "a step"]
    lines = [f"| {' | '.join(columns)} |", "|---|---|---|---:|---:|---:|---:|---:|"]
    kinds = dict.fromkeys(tuple(row[k] for k in _KIND) for row in rows)
    for material, optimizer, start, rate in kinds:
        group = [
            r for r in rows if tuple(r[k] for k in _KIND) == (material, optimizer, start, rate)
        ]
        errors = [r["error"] for r in group]
        beads = np.array([r["beads"] for r in group])
        name = optimizer if rate is None else f"{optimizer}, rate {rate:g}"
        counts = [f"{(beads <= bound).sum()} of {beads.size}" for bound in (0.05, 0.1)]
        cost = f"{1e3 * np.median([r['seconds'] for r in group]):.0f} ms"
        error = f"{np.median(errors):.4f} ({max(errors):.4f})"
        cells = [material, name, start, str(len(group)), error, *counts, cost]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def cells(
    targets: Iterable[int], starts: Iterable[str], rates: Iterable[float] | None
) -> Iterator[Row]:
    """Runs in their order; rates: None: that of the material."""
    for target, material in itertools.product(targets, MATERIALS):
        for start, rate in itertools.product(starts, rates or [RATES[material]]):
            yield {
                "optimizer": "prb_projective", "material": material, "start": start,
                "target": target, "rate": rate,
            }  # fmt: skip
        yield {
            "optimizer": "fide", "material": material, "start": "center",
            "target": target, "rate": None,
        }  # fmt: skip


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    return tuple(row[name] for name in ("optimizer", "material", "start", "target", "rate"))


def main() -> None:
    """Do what is asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--targets", type=span, default=range(10), metavar="A-B")
    parser.add_argument("--rates", type=float, nargs="+", help="of Adam")
    parser.add_argument("--starts", nargs="+", choices=STARTS, default=list(STARTS))
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--check", action="store_true", help="gradients against differences")
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.table:
        print(table(read(arguments.out)))
    elif arguments.check:
        print("| beads | coordinate | gradient | difference |\n|---|---:|---:|---:|")
        for material in MATERIALS:
            print(check(material), flush=True)
    else:
        planned = cells(arguments.targets, arguments.starts, arguments.rates)
        run_missing(
            planned,
            lambda cell: search(cell) if cell["optimizer"] == "fide" else descend(cell),
            arguments.out,
            key,
        )


if __name__ == "__main__":
    main()
