"""Does a learned model find all six glass beads of a new picture? Few thousand renders more.

    fide learn beads --renders 60000 --size 32 --task-set spp=8 --task-set threads=1 \
        --passes 6 --augment render --out runs/beads.fide
    python benchmarks/learned_beads.py --model runs/beads.fide --targets 120-129
    python benchmarks/learned_beads.py --configuration none --targets 120-129
    python benchmarks/learned_beads.py --table

Every run (target, seed, configuration, size, samples, budget, loss) is one line of the output file,
appended when it is done; a second call does what is missing. What counts is the candidate with
the lowest loss after 500, 1,000 and 3,000 renders. Its beads are matched with the true ones as a
set, by the Hungarian method; a bead is found if each of its coordinates is within 5 % of the box,
and a picture if all six are.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from moves import span
from numpy.typing import NDArray
from rows import Row, read, run_missing
from scipy.optimize import linear_sum_assignment

import fide_tasks
from fide_plugins import FIDE
from fide_plugins.validation.options import parse_key_value

RESULTS = Path(__file__).parent / "results" / "learned_beads.jsonl"
MARKS = (500, 1000, 3000)
NEAR = (0.02, 0.05, 0.1)
_AXES = 3


def cells(arguments: argparse.Namespace, configuration: str) -> Iterator[Row]:
    """All runs."""
    for target in arguments.targets:
        yield {
            "scene": arguments.scene, "target": target, "seed": arguments.seed,
            "configuration": configuration, "size": arguments.size, "spp": arguments.spp,
            "budget": arguments.budget, "loss": arguments.loss,
        }  # fmt: skip


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    names = ("scene", "target", "seed", "configuration", "size", "spp", "budget", "loss")
    return tuple(row[name] for name in names)


def kind_of(row: Row) -> tuple[Any, ...]:
    """What runs of one line of the table have in common; scene, configuration and budget first."""
    names = ("scene", "configuration", "budget", "size", "spp", "loss")
    return tuple(row[name] for name in names)


def measure(row: Row, model: str | None, options: dict[str, Any]) -> Row:
    """One run: how far each bead of the best candidate is from the truth, at each mark."""
    task: Any = fide_tasks.make(row["scene"], row["size"], row["target"], spp=row["spp"], threads=1)
    start = time.process_time()
    opt = FIDE(
        task.space, task.target, loss=row["loss"], learned=model, seed=row["seed"], **options
    )
    best, bead = np.inf, np.ones(task.dim // _AXES)
    marks: dict[str, Row] = {}
    first: list[float] | None = None
    while opt.evaluations < row["budget"]:
        before = opt.evaluations
        end = min([m for m in MARKS if m > before] + [row["budget"]])
        X = opt.ask()[: end - before]
        losses = opt.tell(X, task.render(X, seed=list(range(before, before + len(X)))))
        k = int(np.argmin(losses))
        if losses[k] < best:
            best, bead = float(losses[k]), apart(X[k], task.x_star)
        if first is None:
            first = min((apart(x, task.x_star) for x in X), key=max).tolist()
        if opt.evaluations in {*MARKS, row["budget"]}:
            beads = [round(a, 4) for a in sorted(bead.tolist())]
            marks[str(opt.evaluations)] = {"loss": best, "beads": beads}
    return {
        **row,
        "marks": marks,
        "nearest_of_first_generation": [round(a, 4) for a in sorted(first or [])],
        "cpu_s": round(time.process_time() - start, 1),
    }


def apart(x: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of each true bead from its own of x, the worst coordinate, in units of the box."""
    found, true = x.reshape(-1, _AXES), truth.reshape(-1, _AXES)
    distance = np.abs(found[:, None] - true[None]).max(axis=-1)
    mine, its = linear_sum_assignment(distance)
    return np.asarray(distance[mine[np.argsort(its)], np.sort(its)], np.float64)


def table(rows: list[Row]) -> str:
    """Pictures whose beads were all found, and beads that were, in Markdown."""
    lines = ["| scene | configuration | renders | " + " | ".join(f"all within {n}" for n in NEAR)]
    lines[0] += " | beads within 0.05, of a picture |"
    lines.append("|---|---|" + "---:|" * (len(NEAR) + 2))
    for kind in dict.fromkeys(map(kind_of, rows)):
        group = [r for r in rows if kind_of(r) == kind]
        for mark in group[0]["marks"]:
            beads = np.array([row["marks"][mark]["beads"] for row in group])
            counts = [f"{(beads <= n).all(axis=1).sum()} of {len(group)}" for n in NEAR]
            mean = (beads <= 0.05).sum(axis=1).mean()
            lines.append(
                f"| {kind[0]} | {kind[1]} | {int(mark):,} | {' | '.join(counts)} | {mean:.1f} |"
            )
    return "\n".join(lines)


def main() -> None:
    """Do what is asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default="beads")
    parser.add_argument("--model", help="file of a model; without it the search has none")
    parser.add_argument("--targets", type=span, default=range(120, 130), metavar="A-B")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, default=56)
    parser.add_argument("--spp", type=int, default=8)
    parser.add_argument("--budget", type=int, default=MARKS[-1])
    parser.add_argument("--loss", default="perceptual")
    parser.add_argument(
        "--configuration", nargs="+", default=["learned"], metavar="NAME [KEY=VALUE]"
    )
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.out)))
        return
    torch.set_num_threads(1)
    name, *pairs = arguments.configuration
    if name == "learned" and not arguments.model:
        parser.error("the configuration 'learned' needs --model; without one name it otherwise")
    options = dict(parse_key_value(pair) for pair in pairs)
    run_missing(
        cells(arguments, name),
        lambda cell: measure(cell, arguments.model, options),
        arguments.out,
        key,
    )


if __name__ == "__main__":
    main()
