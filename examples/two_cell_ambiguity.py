"""Two cells, one image, two answers: a regression averages them, diffusion finds both.

The image is the distance from the nearest of two centers, so swapping the centers changes nothing
(the paper's Fig. 2).  One network learns from random scenes which parameters produced an image.
Its mean answer puts both cells on top of each other, halfway between.  Its samples have one order
of the cells or the other.

    python examples/two_cell_ambiguity.py [--out two_cells.png]

Takes about half a minute on two cores.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import fide_tasks
from fide_lab.baselines.image_based import PosteriorSampler
from fide_plugins import encoders
from fide_tasks.base import Task

Floats = NDArray[np.float64]
NEAR = 0.1  # a sample is at a mode if each coordinate is within this fraction of the image side


@dataclass(frozen=True)
class Outcome:
    """The network's answers for the task's target."""

    task: Task
    samples: Floats  # (n, 4): x and y of the first cell, then of the second
    regression: Floats  # (4,)

    def modes(self) -> Floats:
        """Return the two parameter vectors that produce the target, (2, 4)."""
        assert self.task.x_star is not None
        return np.stack([self.task.x_star, np.roll(self.task.x_star, 2)])

    def shares(self) -> Floats:
        """Return the fraction of samples at each mode, (2,)."""
        distance = np.abs(self.samples[:, None] - self.modes()).max(axis=2)  # (n, 2)
        share: Floats = (distance < NEAR).mean(axis=0)
        return share

    def errors(self, x: Floats) -> Floats:
        """Return the mean squared error of the images of `x` (n, 4)."""
        wrong = self.task.render(x) - self.task.target
        error: Floats = np.square(wrong, dtype=np.float64).mean(axis=(1, 2, 3))
        return error


def run(scenes: int = 16_000, size: int = 32, epochs: int = 14, seed: int = 0) -> Outcome:
    """Train on random scenes, then predict for the task's target."""
    task = fide_tasks.make("voronoi", size=size, seed=0, variant="distance")
    encode = encoders.make("patch")
    x = np.random.default_rng(seed).random((scenes, task.dim))
    tokens = encode(task.render(x))
    predictor = PosteriorSampler(task.dim, seed=seed, batch_size=100, width=32, blocks=2)
    predictor.fit(x, tokens, epochs)
    target = encode(task.target[None])[0]
    return Outcome(task, predictor.sample(200, target), predictor.regress(target))


def draw(outcome: Outcome, path: Path) -> None:
    """Write the target, the regression and samples from both modes, with their centers."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    large = fide_tasks.make("voronoi", size=256, seed=0, variant="distance")
    near = np.abs(outcome.samples[:, None] - outcome.modes()).max(axis=2).argmin(axis=1)
    error = outcome.errors(outcome.samples)
    share = outcome.shares()
    rows = [("target", outcome.modes()[:1], ""), ("regression", outcome.regression[None], "")]
    rows[1] = ("regression", rows[1][1], f"MSE {outcome.errors(rows[1][1])[0]:.4f}")
    for mode in (0, 1):
        own = outcome.samples[near == mode][:40]
        text = f"{share[mode]:.0%} at this answer, median MSE {np.median(error[near == mode]):.4f}"
        rows.append((f"diffusion, answer {mode + 1}", own, text))
    figure, axes = plt.subplots(1, 4, figsize=(13, 3.9))
    for axis, (title, x, text) in zip(axes, rows, strict=True):
        axis.imshow(large.render(x[:1])[0, :, :, 0], cmap="gray", vmin=0, vmax=0.6)
        for columns, color, name in (([0, 1], "tab:orange", "A"), ([2, 3], "tab:cyan", "B")):
            axis.plot(*(256 * x[:, columns].T - 0.5), ".", color=color, markersize=7, alpha=0.6)
            middle = np.median(x[:, columns], axis=0) * 256
            axis.annotate(name, middle, (7, 7), textcoords="offset points", color=color, size=16)
        axis.set(xlim=(-0.5, 255.5), ylim=(255.5, -0.5), xticks=[], yticks=[], xlabel=text)
        axis.set_title(title)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Run the experiment, print its numbers, write its picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("two_cells.png"), help="output image")
    out: Path = parser.parse_args().out
    outcome = run()
    first, second = outcome.shares()
    print(f"samples at the first answer {first:.0%}, at the second {second:.0%}")
    print(f"median MSE of samples {np.median(outcome.errors(outcome.samples)):.5f}")
    print(f"MSE of the regression {outcome.errors(outcome.regression[None])[0]:.5f}")
    draw(outcome, out)
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
