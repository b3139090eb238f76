"""`turbo` against its authors' program, from the same functions and with the same settings.

    git clone https://github.com/uber-research/TuRBO && git -C TuRBO checkout de0db39
    PYTHONPATH=TuRBO python benchmarks/turbo_authors.py > benchmarks/results/turbo_authors.jsonl

Functions of `baselines.py` with 10 parameters; 120 evaluations in batches of 4, after 20 of a Latin
hypercube.  A line has the best values after 60 and after 120, and the processor's seconds.  The
program's license is for non-commercial use; nothing of it is here.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from baselines import in_the_unit_cube

from fide_plugins import optimizers
from fide_plugins.types import Float64

DIM, BATCH, HALF, BUDGET = 10, 4, 60, 120


def main() -> None:
    """Five seeds of three functions."""
    for seed in range(5):
        for name in ("ackley", "rosenbrock", "levy"):
            function = in_the_unit_cube(name, DIM, seed)
            runs, seconds = [], []
            for run in (ours, theirs):
                start = time.process_time()
                losses = run(function, seed)
                seconds.append(round(time.process_time() - start, 1))
                runs.append([float(losses[:HALF].min()), float(losses[:BUDGET].min())])
            row = {"f": name, "seed": seed, "ours": runs[0], "theirs": runs[1], "cpu": seconds}
            print(json.dumps(row), flush=True)


def ours(function: Callable[[Float64], Float64], seed: int) -> Float64:
    """Losses in the order of their evaluation."""
    opt = optimizers.make("turbo", DIM, seed=seed, popsize=BATCH)
    losses: list[float] = []
    while len(losses) < BUDGET:
        X = opt.ask()
        values = function(X)
        opt.tell(X, losses=values)
        losses.extend(values.tolist())
    return np.array(losses)


def theirs(function: Callable[[Float64], Float64], seed: int) -> Float64:
    """The same by the authors' program."""
    from turbo import Turbo1

    np.random.seed(seed)
    torch.manual_seed(seed)
    program: Any = Turbo1(
        f=lambda x: float(function(x[None])[0]),
        lb=np.zeros(DIM),
        ub=np.ones(DIM),
        n_init=2 * DIM,
        max_evals=BUDGET,
        batch_size=BATCH,
        verbose=False,
    )
    program.optimize()
    losses: Float64 = program.fX.ravel()
    return losses


if __name__ == "__main__":
    main()
