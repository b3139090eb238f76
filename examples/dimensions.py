"""More parameters need more renders: Voronoi pictures of 8, 12 and 16 cells.

40, 60 and 80 parameters, with the same start for all.  Writes a picture of the loss curves and the
results.

    python examples/dimensions.py
    python examples/dimensions.py --size 224 --budget 25000 [--set preset=paper]

Takes a quarter of a minute with the default options.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from fide_lab import run as harness
from fide_plugins.validation.options import parse_key_value


def draw(results: list[harness.RunResult], targets: list[np.ndarray], path: Path) -> None:
    """Write the loss against renders, and each target beside its result."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure = plt.figure(figsize=(9, 4.2))
    grid = figure.add_gridspec(2, 2 + len(results), width_ratios=[2.2, 0.1, *[1] * len(results)])
    curve = figure.add_subplot(grid[:, 0])
    for i, (result, target) in enumerate(zip(results, targets, strict=True)):
        curve.semilogy(np.minimum.accumulate(result.losses), label=f"{result.dim} parameters")
        for row, (image, title) in enumerate(((target, "target"), (result.image, "found"))):
            axis = figure.add_subplot(grid[row, 2 + i])
            if image is not None:  # None if no loss was finite
                axis.imshow(image)
            axis.set(xticks=[], yticks=[])
            axis.set_title(f"{title}, {result.dim}" if row == 0 else title, fontsize=9)
    curve.set(xlabel="renders", ylabel="best MSE so far")
    curve.legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Run all, print a table, write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cells", type=int, nargs="+", default=[8, 12, 16])
    parser.add_argument("--size", type=int, default=64, help="image side, pixels")
    parser.add_argument("--budget", type=int, default=2000, help="renders")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="options of FIDE")
    parser.add_argument("--out", type=Path, default=Path("dimensions.png"), help="output image")
    args = parser.parse_args()
    marks = [round(args.budget * share) for share in (0.1, 0.25, 0.5, 1.0)]
    titles = [*(f"MSE at {mark}" for mark in marks), "own ms each"]
    print("parameters" + "".join(f"{title:>16}" for title in titles))
    results, targets = [], []
    for cells in args.cells:
        run = harness.prepare(
            "voronoi",
            "fide",
            "mse",
            args.budget,
            args.seed,
            size=args.size,
            task_options={"cells": cells},
            options=dict(parse_key_value(text) for text in args.set),
        )
        results.append(run.execute())
        targets.append(run.target)
        best = np.minimum.accumulate(results[-1].losses)
        numbers = "".join(f"{best[mark - 1]:16.5f}" for mark in marks)
        own = 1e3 * results[-1].overhead_s / args.budget  # of FIDE itself, for each candidate
        print(f"{run.task.dim:10d}{numbers}{own:16.2f}", flush=True)
    draw(results, targets, args.out)
    print(f"wrote {args.out}")


if __name__ == "__main__":
    main()
