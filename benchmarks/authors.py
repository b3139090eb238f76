"""`turbo`, `dibo` and `zerograds` against the programs of their authors, on the same functions.

    git clone https://github.com/uber-research/TuRBO && git -C TuRBO checkout de0db39
    git clone https://github.com/umkiyoung/DiBO && git -C DiBO checkout 31ff265
    pip install torchdiffeq==0.2.5
    python benchmarks/authors.py turbo --program TuRBO
    python benchmarks/authors.py dibo --program DiBO
    python benchmarks/authors.py dibo:schedule=paper --program DiBO
    python benchmarks/authors.py dibo:likelihood=exact --program DiBO
    git clone https://github.com/mfischer-ucl/zerograds && git -C zerograds checkout 7490db8
    python benchmarks/authors.py zerograds --program zerograds
    python benchmarks/authors.py zerograds:scale=none --program zerograds
    python benchmarks/authors.py zerograds:authors --program zerograds
    python benchmarks/authors.py zerograds:authors:box --program zerograds
    python benchmarks/authors.py zerograds:rates=0.002,0.003 --program zerograds
    python benchmarks/authors.py table

Functions of `baselines.py`, five seeds.  `turbo`: 5, 10 and 20 parameters, 12 d evaluations in
batches of 4, after 2 d of a Latin hypercube; of ours the first is the center, and with 5 parameters
they are 12, whole batches.  `dibo`: 10, 20 and 40 parameters, 400 evaluations in batches of 50, of
which both have the first 100 in common; the small networks of `baselines.py`, in double precision.
Of DiBO the whole script is run, unchanged, on these functions in place of its own.  `zerograds`: 5,
10 and 20 parameters, 5,000 evaluations, 21 a step, with the learning rates of
`authors_zerograds.py` for the program, which asks for points outside of the box, too: the functions
have values there.  Its defaults were chosen on the first five seeds among four pairs of rates
(`zerograds:rates=...`), so it is raced on five others.

Every pair is a line of the output file: the lowest value of each, and the processor's seconds.  A
second call does the missing pairs.  TuRBO's license is for non-commercial use; nothing of
these programs is here.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import importlib
import io
import os
import runpy
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from authors_zerograds import BEST, EVALUATIONS, OFFSETS, zerograds
from baselines import SMALL_DIBO, in_the_unit_cube
from rows import Row, read, run_missing

from fide_lab import optimizers
from fide_lab.suite.page import sign_test
from fide_plugins.types import Float64

RESULTS = Path(__file__).parent / "results" / "authors.jsonl"
PAPER = "dibo:schedule=paper"  # with the variances of the DiBO paper, not of its program
EXACT = "dibo:likelihood=exact"  # with the likelihood of the model, not that of its program
RAW = "zerograds:scale=none"  # learns losses as they are, as its program does
SAME = "zerograds:authors"  # the same, with the learning rates of the program on each function
BOX = "zerograds:authors:box"  # and the program is told of the nearest point in the box
RATES = {
    f"zerograds:rates={a:g},{b:g}": {"learning_rate": a, "proxy_rate": b}
    for a, b in ((2e-3, 3e-3), (2e-3, 1e-2), (1e-3, 1e-2), (1e-3, 2e-2))
}
"""Rates of the parameter and of the network to choose from; the first were the defaults before."""
FORMER_RAW = "zerograds:rates=0.002,0.003:scale=none"
FUNCTIONS = {
    "turbo": ("ackley", "rosenbrock", "levy"),
    "dibo": ("ackley", "rosenbrock", "levy", "rastrigin"),
    PAPER: ("ackley", "rosenbrock"),
    EXACT: ("ackley", "rosenbrock"),
    "zerograds": tuple(BEST),
    RAW: tuple(BEST),
    SAME: tuple(BEST),
    BOX: ("ackley",),
    FORMER_RAW: tuple(BEST),
    **{name: tuple(BEST) for name in RATES},
}
DIMS = {"turbo": (5, 10, 20), "dibo": (10, 20, 40), "zerograds": (5, 10, 20)}
SEEDS = 5
FRESH = (*range(5, 10),)  # the first five have chosen the rates
BATCH = {"turbo": 4, "dibo": 50, "zerograds": 2 * OFFSETS + 1}
DESIGN = 100  # evaluations of `dibo` before the first round
SEARCH_EPOCHS = 10  # of the script; steps of Adam on each candidate
DIBO = {
    **SMALL_DIBO,
    "precision": "double",
    "initial": DESIGN,
    "search_epochs": SEARCH_EPOCHS,
    "schedule": "authors",
}
OPTIONS: dict[str, dict[str, Any]] = {
    "turbo": {},
    "dibo": DIBO,
    PAPER: {**DIBO, "schedule": "paper"},
    EXACT: {**DIBO, "likelihood": "exact"},
    "zerograds": {},
    RAW: {"scale": "none"},
    FORMER_RAW: {"learning_rate": 2e-3, "proxy_rate": 3e-3, "scale": "none"},
    **RATES,
}

Function = Callable[[Float64], Float64]


def evaluations(baseline: str, dim: int) -> int:
    """Of one run."""
    return {"turbo": 12 * dim, "dibo": 400, "zerograds": EVALUATIONS}[method(baseline)]


def method(baseline: str) -> str:
    """Its name without options."""
    return baseline.partition(":")[0]


def pairs(baseline: str) -> Iterator[Row]:
    """All of a baseline, seeds outermost."""
    for seed in FRESH if baseline in ("zerograds", RAW, SAME, BOX) else range(SEEDS):
        for dim in DIMS[method(baseline)]:
            for f in FUNCTIONS[baseline]:
                yield {"baseline": baseline, "f": f, "dim": dim, "seed": seed}


def key(pair: Row) -> tuple[Any, ...]:
    """What makes a pair."""
    return pair["baseline"], pair["f"], pair["dim"], pair["seed"]


def options_of(cell: Row) -> dict[str, Any]:
    """Of our optimizer."""
    if cell["baseline"] not in (SAME, BOX):
        return OPTIONS[cell["baseline"]]
    learning_rate, proxy_rate = BEST[cell["f"]]
    return {"scale": "none", "learning_rate": learning_rate, "proxy_rate": proxy_rate}


def ours(cell: Row, function: Function) -> tuple[Float64, Float64]:
    """Points and losses in the order of their evaluation."""
    baseline, dim, seed = cell["baseline"], cell["dim"], cell["seed"]
    name = method(baseline)
    opt = optimizers.make(name, dim, seed=seed, popsize=BATCH[name], **options_of(cell))
    points: list[Float64] = []
    losses: list[float] = []
    while len(losses) < evaluations(baseline, dim):
        X = opt.ask()
        values = function(X)
        opt.tell(X, losses=values)
        points.extend(X)
        losses.extend(values.tolist())
    return np.array(points), np.array(losses)


def turbo(root: Path, function: Function, dim: int) -> Float64:
    """Losses of TuRBO's program."""
    sys.path.insert(0, str(root))
    program: Any = importlib.import_module("turbo").Turbo1(
        f=lambda x: float(function(x[None])[0]),
        lb=np.zeros(dim),
        ub=np.ones(dim),
        n_init=2 * dim,
        max_evals=evaluations("turbo", dim),
        batch_size=BATCH["turbo"],
        verbose=False,
    )
    program.optimize()
    losses: Float64 = program.fX.ravel()
    return losses


def dibo(root: Path, function: Function, dim: int, seed: int, design: Float64) -> Float64:
    """Losses of DiBO's program, which begins at a design (DESIGN, dim)."""
    make_importable(root, test_function(function, design))
    settings = {
        "dim": dim,
        "seed": seed,
        "n_init": DESIGN,
        "max_evals": evaluations("dibo", dim),
        "batch_size": BATCH["dibo"],
        "train_batch_size": SMALL_DIBO["batch"],
        "proxy_hidden_dim": SMALL_DIBO["proxy_width"],
        "num_proposals": SMALL_DIBO["proposals"],
        "buffer_size": 300,
        "local_search_epochs": SEARCH_EPOCHS,
    }
    words = [word for name, value in settings.items() for word in (f"--{name}", str(value))]
    found = run_script(root / "baselines" / "algorithms" / "dibo.py", words)
    losses: Float64 = -found["Y_total"].ravel()
    return losses


def test_function(function: Function, design: Float64) -> type:
    """Class of a function in place of DiBO's own; a search of it begins at the design."""

    class TestFunction(torch.utils.data.Dataset[Any]):
        """The program maximizes."""

        def __init__(self, **_: Any) -> None:
            self.X = torch.tensor(design)
            self.Y = -torch.tensor(function(design))[:, None]

        def eval_objective(self, x: torch.Tensor) -> float:
            return -float(function(x.numpy()[None])[0])

        def __len__(self) -> int:
            return len(self.X)

        def __getitem__(self, i: int) -> tuple[torch.Tensor, torch.Tensor]:
            return self.X[i], self.Y[i]

    return TestFunction


def make_importable(root: Path, of_test: type) -> None:
    """Find DiBO's modules, with our class of a function, without reports, with a small network."""
    for name in [name for name in sys.modules if name.split(".")[0] == "baselines"]:
        del sys.modules[name]  # of FIDE's benchmarks, or of the last run
    sys.path.insert(0, str(root))
    module = ModuleType("baselines.functions.test_function")
    log: Any = ModuleType("wandb")  # reports to a server
    log.init = log.log = log.Histogram = lambda *_, **__: None
    sys.modules.update({module.__name__: module, "wandb": log})
    module.TestFunction = of_test  # type: ignore[attr-defined]
    models: Any = importlib.import_module("baselines.models.diffusion")
    of_prior = models.DiffusionModel
    of_prior.__init__ = functools.partialmethod(of_prior.__init__, hidden_dim=SMALL_DIBO["width"])


def run_script(path: Path, words: list[str]) -> dict[str, Any]:
    """Globals of a script after a silent run in an empty folder, which is then deleted."""
    script = str(path.resolve())
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        before, sys.argv = sys.argv, [path.name, *words]
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                return runpy.run_path(script, run_name="__main__")
        finally:
            sys.argv = before


def in_the_box(function: Function) -> Function:
    """The function at the nearest point of the unit box."""
    return lambda X: function(np.clip(X, 0.0, 1.0))


def program(cell: Row, root: Path, function: Function, design: Float64) -> Float64:
    """Losses of the authors' program."""
    baseline, dim, seed = cell["baseline"], cell["dim"], cell["seed"]
    np.random.seed(seed)
    torch.manual_seed(seed)
    if method(baseline) == "zerograds":
        if baseline == BOX:
            return zerograds(root, in_the_box(function), dim, seed, BEST[cell["f"]])
        return zerograds(root, function, dim, seed, BEST[cell["f"]])
    if baseline == "turbo":
        return turbo(root, function, dim)
    return dibo(root, function, dim, seed, design)


def measure(cell: Row, root: Path) -> Row:
    """One pair."""
    baseline, dim, seed = cell["baseline"], cell["dim"], cell["seed"]
    function = in_the_unit_cube(cell["f"], dim, seed)
    start = time.process_time()
    points, mine = ours(cell, function)
    middle = time.process_time()
    theirs = program(cell, root, function, points[:DESIGN])
    cpu = [round(middle - start, 1), round(time.process_time() - middle, 1)]
    n = evaluations(baseline, dim)
    lowest = {"ours": float(mine[:n].min()), "theirs": float(theirs[:n].min())}
    return {**cell, "evaluations": n, **lowest, "cpu": cpu}


def table(rows: list[Row]) -> str:
    """Of all pairs, in Markdown: lower in, medians of the ratio, exact sign test."""
    lines = [
        "| baseline | function | parameters | lower than authors' | median of ours / theirs | p |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for baseline, functions in FUNCTIONS.items():
        mine = [row for row in rows if row["baseline"] == baseline]
        for f in functions:
            of_f = [row for row in mine if row["f"] == f]
            if ":" not in baseline or method(baseline) == "dibo":
                for dim in DIMS[method(baseline)]:
                    some = [row for row in of_f if row["dim"] == dim]
                    lines += line(f"`{baseline}` | {f} | {dim}", some, test=False)
            lines += line(f"`{baseline}` | {f} | all", of_f)
        if len(functions) > 1:
            lines += line(f"`{baseline}` | all | all", mine)
    return "\n".join(lines)


def line(head: str, rows: list[Row], test: bool = True) -> list[str]:
    """Of some pairs; none if there are no pairs."""
    if not rows:
        return []
    ours, theirs = (np.array([row[whose] for row in rows]) for whose in ("ours", "theirs"))
    lower, ratio = int((ours < theirs).sum()), float(np.median(ours / theirs))
    p = f"{sign_test(ours, theirs):.2g}" if test else ""
    return [f"| {head} | {lower} of {len(rows)} | {ratio:.2f} | {p} |"]


def main() -> None:
    """Measure, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("what", choices=(*FUNCTIONS, "table"))
    parser.add_argument("--program", type=Path, help="folder of the authors' program")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    if arguments.what == "table":
        print(table(read(arguments.out)))
        return
    if arguments.program is None:
        parser.error("--program is needed: the folder of the authors' program")
    run_missing(
        pairs(arguments.what), lambda cell: measure(cell, arguments.program), arguments.out, key
    )


if __name__ == "__main__":
    main()
