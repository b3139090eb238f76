"""The inverse step alone: predict the control points of a stroke from one image.

A network learns from random strokes which control points produced an image, over the whole box,
without evolution (the paper's Sec. 4.1).  With two control points its samples resemble the target.
With more points they are less accurate, but still nearer to the target than random strokes.  FIDE
then finds the target with fewer renders.

    python examples/inverse_splines.py [--scenes 50000 --epochs 30] [--out splines.png]

Takes three quarters of a minute with the default options.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import fide_tasks
from fide_lab.baselines.image_based import PosteriorSampler
from fide_plugins import FIDE, encoders
from fide_tasks.base import Task

Floats = NDArray[np.float64]
THICKNESS = 0.15  # of the stroke, in image sides; known to all methods
SHOWN = 4  # samples in the picture


@dataclass(frozen=True)
class Strokes:
    """Strokes of one thickness: 2 m parameters, x and y of each control point."""

    task: Task
    target: NDArray[np.float32]

    @property
    def dim(self) -> int:
        return self.task.dim - 1

    def render(self, x: Floats) -> NDArray[np.float32]:
        thickness = np.full((len(x), 1), THICKNESS)
        images: NDArray[np.float32] = self.task.render(np.concatenate([x, thickness], axis=1))
        return images

    def errors(self, x: Floats) -> Floats:
        """Return the mean squared error of the images of `x` (n, d)."""
        wrong = np.square(self.render(x) - self.target, dtype=np.float64)
        error: Floats = wrong.mean(axis=(1, 2, 3))
        return error


@dataclass(frozen=True)
class Row:
    """The results for one number of control points, (n, d) each."""

    strokes: Strokes
    random: Floats
    inverse: Floats
    fide: Floats

    def report(self) -> str:
        median = [np.median(self.strokes.errors(x)) for x in (self.random, self.inverse, self.fide)]
        numbers = "".join(f"{error:16.4f}" for error in median)
        return f"{self.strokes.dim // 2:8d}{numbers}"


def make_strokes(points: int, size: int, seed: int) -> Strokes:
    """The task of finding a random stroke with that many control points."""
    task = fide_tasks.make("spline", size, seed, control_points=points, target="random")
    assert task.x_star is not None
    strokes = Strokes(task, task.target)
    return Strokes(task, strokes.render(task.x_star[None, :-1])[0])


def solve(strokes: Strokes, scenes: int, epochs: int, renders: int, seed: int) -> Row:
    """Compare the inverse step, random strokes, and FIDE."""
    encode = encoders.make("patch")
    x = np.random.default_rng(seed).random((scenes, strokes.dim))
    small = {"batch_size": 100, "width": 32, "blocks": 2}
    predictor = PosteriorSampler(strokes.dim, seed=seed, learning_rate=2e-3, **small)
    predictor.fit(x, encode(strokes.render(x)), epochs)
    samples = predictor.sample(100, encode(strokes.target[None])[0])
    opt = FIDE(strokes.dim, strokes.target, seed=seed)
    while opt.evaluations < renders:
        X = opt.ask()
        opt.tell(X, strokes.render(X))
    assert opt.best is not None
    return Row(strokes, x[:100], samples, opt.best.x[None])


def draw(rows: list[Row], path: Path) -> None:
    """Write a grid: samples of the inverse step, FIDE's result, the target."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    titles = [*["inverse step alone"] * SHOWN, "FIDE", "target"]
    size = (1.7 * len(titles), 1.9 * len(rows))
    figure, axes = plt.subplots(len(rows), len(titles), figsize=size, squeeze=False)
    for row, line in zip(rows, axes, strict=True):
        found = np.concatenate([row.inverse[:SHOWN], row.fide])
        images = [*row.strokes.render(found), row.strokes.target]
        captions = [*(f"{error:.4f}" for error in row.strokes.errors(found)), ""]
        for axis, image, title, caption in zip(line, images, titles, captions, strict=True):
            axis.imshow(image)
            axis.set(xticks=[], yticks=[], xlabel=caption)
            if row is rows[0]:
                axis.set_title(title, fontsize=9)
        line[0].set_ylabel(f"{row.strokes.dim // 2} points")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Run the experiment, print its numbers, write its picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--points", type=int, nargs="+", default=[2, 3, 4, 5])
    parser.add_argument("--scenes", type=int, default=5000, help="training scenes")
    parser.add_argument("--renders", type=int, default=1500, help="renders of FIDE")
    parser.add_argument("--epochs", type=int, default=12)
    parser.add_argument("--size", type=int, default=32, help="image side, pixels")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("splines.png"), help="output image")
    args = parser.parse_args()
    print("  points   random strokes    inverse step            FIDE   (median MSE)")
    rows = []
    for points in args.points:
        strokes = make_strokes(points, args.size, args.seed)
        rows.append(solve(strokes, args.scenes, args.epochs, args.renders, args.seed))
        print(rows[-1].report(), flush=True)
    draw(rows, args.out)
    print(f"wrote {args.out}")


if __name__ == "__main__":
    main()
