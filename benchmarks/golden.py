"""Golden runs show whether a change of the code leaves every candidate as it was, bit for bit.

    python benchmarks/golden.py write golden.json
    ... change the code ...
    python benchmarks/golden.py compare golden.json [--only PATTERN]

`write` performs a fixed list of short runs and stores SHA-256 hashes of each generation: the bytes
of its candidates (float64), of their losses, of `recommend()` and of `best`.  Many generations are
cut in two: the optimizer is saved between the halves, and a loaded copy continues for two more
generations, which are hashed too.  The checkpoint file itself is not hashed; its format may change.

`compare` performs the same runs again and prints one line for each: "same", or the first generation
that differs and what differs in it.  It exits with 1 if a run differs or fails.  Hashes agree only
on one machine with the same libraries.  One thread computes.

Only public names are used, so that one script serves before and after a refactoring.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
import os
import platform
import runpy
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import cv2
import numpy as np
import torch
from golden_adapters import command, nevergrad, nevergrad_mixed, optuna
from golden_search import (
    RESUMED,
    Tell,
    Trace,
    baseline,
    disorder,
    fide,
    pieces,
    problem,
    sphere_alone,
    tell_both,
    tell_failures,
    tell_float32,
    tell_losses,
    tell_noise,
    tell_others,
    tell_sometimes,
)

# -- the list --------------------------------------------------------------------------------------

Run: TypeAlias = Callable[[Trace], None]

VORONOI = partial(problem, size=56, cells=6)
SPLINE = partial(problem, "spline", size=56)
MANY = partial(problem, cells=12)  # 60 parameters
SMALL: dict[str, dict[str, Any]] = runpy.run_path(
    str(Path(__file__).parents[1] / "tests" / "lab" / "baselines" / "small.py")
)["OPTIONS"]
PAPER: dict[str, Any] = {"preset": "paper", "popsize": 24, "epochs": 2, "evaluations": 96}
STYLES: Mapping[str, Tell] = {
    "losses and images": tell_both,
    "losses only": tell_losses,
    "float32 points": tell_float32,
    "misleading images, noise": tell_noise,
    "misleading images, of others": tell_others,
    "failures": tell_failures,
    "images sometimes": tell_sometimes,
}

RUNS: dict[str, Run] = {
    **{
        f"{preset} {name} seed {seed}": partial(
            fide, p=p, evaluations=evaluations, seed=seed, preset=preset
        )
        for preset, evaluations in (("fast", 2500), ("balanced", 2500), ("accurate", 2500))
        for name, p, seed in (("voronoi", VORONOI, 0), ("spline", SPLINE, 1))
    },
    "paper": partial(fide, **PAPER),
    "paper, in pieces": partial(pieces, steps=30, preset="paper", popsize=20, epochs=2),
    "diffusion with restarts": partial(
        fide, proposer="diffusion", popsize=12, epochs=2, patience=3, evaluations=360
    ),
    "diffusion anew": partial(
        fide, proposer="diffusion", popsize=12, epochs=2, patience=2, restarts="anew"
    ),
    "cma-es alone": partial(fide, p=VORONOI, proposer="none", evaluations=800),
    "cma-es converged": sphere_alone,
    "restarts anew": partial(fide, restarts="anew", patience=3, evaluations=1000),
    "restarts none": partial(fide, restarts="none", evaluations=800),
    "many parameters": partial(fide, p=MANY, popsize=8, evaluations=800),
    "many parameters, cma-es alone": partial(
        fide, p=MANY, popsize=8, proposer="none", evaluations=800
    ),
    "many parameters, disorder": partial(disorder, popsize=5, patience=4),
    **{f"tell {name}": partial(fide, tell=tell, patience=4) for name, tell in STYLES.items()},
    "disorder": partial(disorder, popsize=8, patience=3),
    "disorder, fast": partial(disorder, popsize=9, patience=3, preset="fast", seed=1),
    "disorder, cma-es alone": partial(disorder, popsize=8, proposer="none", seed=2),
    "disorder, paper": partial(disorder, steps=12, popsize=12, preset="paper", epochs=1, seed=3),
    "pieces": partial(pieces, steps=250, popsize=8, patience=3),
    "x0 and sigma0": partial(
        fide, x0=np.linspace(0.2, 0.8, 20), sigma0=np.linspace(0.05, 0.3, 20), patience=4
    ),
    "loi": partial(fide, p=partial(problem, loss="loi"), loss="loi", evaluations=200),
    "perceptual": partial(
        fide, p=partial(problem, loss="perceptual"), loss="perceptual", evaluations=200
    ),
    "patch encoder": partial(fide, encoder="patch", patience=4),
    "optimizers fide": partial(
        baseline, name="fide", evaluations=200, preset="fast", popsize=8, device="cpu"
    ),
    **{
        name: partial(baseline, name=name, evaluations=evaluations, every=every, **SMALL[name])
        for name, evaluations, every in (
            ("random", 60, 3),
            ("cma", 300, 3),
            ("dual-annealing", 80, 20),
            ("fide-annealing", 80, 20),
            ("zerograds", 80, 3),
            ("dibo", 80, 3),
            ("inverse", 120, 3),
            ("dfols", 80, 20),
            ("eki", 100, 3),
        )
    },
    "nevergrad:TwoPointsDE": partial(baseline, name="nevergrad:TwoPointsDE", evaluations=60),
    "optuna:CmaEsSampler": partial(baseline, name="optuna:CmaEsSampler", evaluations=60),
    **{
        f"nevergrad, {workers} workers, {'images' if images else 'losses only'}": partial(
            nevergrad, workers=workers, images=images
        )
        for workers in (1, 4)
        for images in (True, False)
    },
    "nevergrad, mixed": nevergrad_mixed,
    "optuna": partial(optuna),
    "optuna, mixed": partial(optuna, mixed=True),
    "optuna, parallel": partial(optuna, parallel=5),
    "optuna, mixed, parallel": partial(optuna, mixed=True, parallel=5),
    "optuna, two samplers": partial(optuna, parallel=3, trials=48, sqlite=True),
    "command line": partial(command, line="voronoi --budget 300 --set popsize=8"),
    "command line, paper": partial(
        command, line="voronoi --budget 80 --preset paper --set popsize=24 --set epochs=2"
    ),
    "command line, cma": partial(command, line="spline --optimizer cma --budget 120"),
}

# -- write and compare -----------------------------------------------------------------------------


def perform(name: str) -> dict[str, Any]:
    """Generations of a run, and the error that ended it, if one did."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trace, error = Trace(Path(folder)), ""
        try:
            RUNS[name](trace)
        except Exception as raised:  # one run that fails must not hide the others
            error = f"{type(raised).__name__}: {raised}"
    return {"error": error, "generations": trace.generations}


def difference(before: Mapping[str, Any] | None, now: Mapping[str, Any]) -> str:
    """How two performances of a run differ, in words; empty if they do not."""
    if now["error"]:
        return f"FAILED in generation {len(now['generations'])}: {now['error']}"
    if before is None:
        return "NEW: not in the file"
    old, new = before["generations"], now["generations"]
    generation = 0
    for a, b in zip(old, new, strict=False):
        generation += not any(name.startswith(RESUMED) for name in a)
        if a != b:
            names = [name for name in {**a, **b} if a.get(name) != b.get(name)]
            return f"DIFFERS from generation {generation} on: {', '.join(names)}"
    if len(old) != len(new):
        return f"DIFFERS: {len(new)} generations instead of {len(old)}"
    return "DIFFERS: it failed before" if before["error"] else ""


def machine() -> dict[str, str]:
    """What hashes depend on besides the code."""
    versions = {module.__name__: module.__version__ for module in (np, torch, cv2)}
    return {"python": platform.python_version(), "machine": platform.machine(), **versions}


def write(path: Path, names: list[str]) -> int:
    """Perform the runs and store their hashes; 1 if one failed."""
    runs, failed = {}, False
    for name in names:
        began = time.perf_counter()
        runs[name] = perform(name)
        failed |= bool(runs[name]["error"])
        outcome = runs[name]["error"] or f"{len(runs[name]['generations'])} generations"
        print(f"{name:40} {outcome}, {time.perf_counter() - began:.1f} s", flush=True)
        path.write_text(json.dumps({"machine": machine(), "runs": runs}, indent=1) + "\n")
    return int(failed)


def compare(path: Path, names: list[str]) -> int:
    """Perform the runs and compare them with those stored; 1 if one differs."""
    stored = json.loads(path.read_text())
    if stored["machine"] != machine():
        print(f"Caution: {path} was written with {stored['machine']}, this is {machine()}")
    differing = 0
    for name in names:
        found = difference(stored["runs"].get(name), perform(name))
        differing += bool(found)
        print(f"{name:40} {found or 'same'}", flush=True)
    print(f"{differing} of {len(names)} runs differ")
    return int(differing > 0)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("write", "compare"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--only", default="*", help="runs whose name contains this, or matches it")
    arguments = parser.parse_args()
    names = [name for name in RUNS if fnmatch.fnmatchcase(name, f"*{arguments.only}*")]
    if not names:
        parser.error(f"no run matches {arguments.only!r}; runs: {', '.join(RUNS)}")
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    return (write if arguments.action == "write" else compare)(arguments.file, names)


if __name__ == "__main__":
    sys.exit(main())
