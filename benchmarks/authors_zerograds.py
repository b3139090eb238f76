"""The program of ZeroGrads' authors for `authors.py`, and its learning rates.

    python benchmarks/authors_zerograds.py --program zerograds
    python benchmarks/authors_zerograds.py --table

The published learning rates are set by hand for each experiment.  This tries a grid of them on
each function, with two seeds that no race has, and prints geometric means of the lowest value.
Every run is a line of the output file; a second call does the missing ones.

What the program asks the function for is counted, all of it: the points around the parameter, and
the parameter itself after each step, from whose values it takes its result.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import itertools
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from baselines import in_the_unit_cube
from rows import Row, read, run_missing

from fide_plugins.types import Float64

EVALUATIONS = 5000
OFFSETS = 10  # a step, each with both signs
DIMS = (5, 10, 20)
BEST = {
    "ackley": (5e-3, 3e-2),
    "rosenbrock": (2e-3, 3e-1),
    "levy": (5e-4, 1e-2),
    "rastrigin": (5e-4, 3e-2),
}
"""Learning rates of the parameter and of the network: the best of these on each function."""
TRIED = tuple(
    itertools.product(
        (1e-4, 5e-4, 2e-3, 5e-3, 1e-2, 2e-2), (1e-3, 3e-3, 1e-2, 3e-2, 1e-1, 3e-1, 1.0)
    )
)
SEEDS = (100, 101)
RESULTS = Path(__file__).parent / "results" / "authors_zerograds.jsonl"


def zerograds(
    root: Path,
    function: Callable[[Float64], Float64],
    dim: int,
    seed: int,
    rates: tuple[float, float],
) -> Float64:
    """Losses of the program from the center of the box, in the order of their evaluation."""
    np.random.seed(seed)
    torch.manual_seed(seed)
    program, config = load(root)
    losses: list[float] = []

    def render(values: dict[str, torch.Tensor], _: Any) -> dict[str, Any]:
        x = values["x"].detach().numpy().astype(np.float64)
        losses.append(float(function(x[None])[0]))
        return {"img": torch.full((1, 1, 2, 2), losses[-1]), "regTerm": None}

    silence = io.StringIO()
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.chdir(stack.enter_context(tempfile.TemporaryDirectory())))
        stack.enter_context(contextlib.redirect_stdout(silence))
        stack.enter_context(contextlib.redirect_stderr(silence))
        program.optimize_with_proxy(
            settings(config.get_hparams_combined("function", None), dim, rates),
            {},
            render,
            update_fn=lambda values, x, _: {"x": x},
            normalize_fn=lambda x, _: x,  # the box is the unit cube
            provided_gt_img=torch.zeros(1, 1, 2, 2),
        )
    return np.array(losses)


def load(root: Path) -> tuple[Any, Any]:
    """Modules of the program; it draws no pictures of its progress."""
    sys.path.insert(0, str(root.resolve()))
    for name in ("torchinfo", "torchvision", "torchvision.utils"):  # imported, never called
        unused: Any = sys.modules.setdefault(name, ModuleType(name))
        unused.summary = unused.save_image = None
    program: Any = importlib.import_module("train_utils_modular")
    program.show_images = lambda *_, **__: None
    return program, importlib.import_module("config")


def settings(defaults: dict[str, Any], dim: int, rates: tuple[float, float]) -> dict[str, Any]:
    """Of an experiment: the program's defaults, and what it leaves to the experiment."""
    return {
        **defaults,
        "sigma": 1 / 6,
        "device": "cpu",
        "epochs": -(-EVALUATIONS // (2 * OFFSETS + 1)),
        "lr_theta": rates[0],
        "lr_phi": rates[1],
        "batchsize": OFFSETS,
        "smooth_loss": True,
        "criterion": lambda image, _: image.mean(),
        "ndim": dim,
        "theta": torch.full((dim,), 0.5, requires_grad=True),
        "gt_theta": torch.zeros(dim),  # not used: the loss is the function's value
    }


def cells() -> Iterator[Row]:
    """All runs, seeds outermost."""
    for seed, f, dim, rates in itertools.product(SEEDS, BEST, DIMS, TRIED):
        yield {"f": f, "dim": dim, "seed": seed, "rates": rates}


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    return row["f"], row["dim"], row["seed"], *row["rates"]


def measure(cell: Row, root: Path) -> Row:
    """One run."""
    f, dim, seed = cell["f"], cell["dim"], cell["seed"]
    losses = zerograds(root, in_the_unit_cube(f, dim, seed), dim, seed, cell["rates"])
    lowest = float(losses[:EVALUATIONS].min())
    return {**cell, "evaluations": EVALUATIONS, "theirs": lowest}


def table(rows: list[Row]) -> str:
    """Geometric means over dimensions and seeds, in Markdown."""
    lines = [f"| rate of the parameter, of the network | {' | '.join(BEST)} |"]
    lines.append("|---" + "|---:" * len(BEST) + "|")
    for rates in TRIED:
        means = []
        for f in BEST:
            mine = [r["theirs"] for r in rows if (r["f"], *r["rates"]) == (f, *rates)]
            means.append(f"{np.exp(np.log(mine).mean()):.3g}" if mine else "")
        lines.append(f"| {rates[0]:g}, {rates[1]:g} | {' | '.join(means)} |")
    return "\n".join(lines)


def main() -> None:
    """Measure, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--program", type=Path, help="folder of the authors' program")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    if not arguments.table:
        if arguments.program is None:
            parser.error("--program is needed: the folder of the authors' program")
        run_missing(cells(), lambda cell: measure(cell, arguments.program), arguments.out, key)
    print(table(read(arguments.out)))


if __name__ == "__main__":
    main()
