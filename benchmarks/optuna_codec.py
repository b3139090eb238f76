"""What is lost when workers learn from stored features, compressed to 2,600 bytes.

    python benchmarks/optuna_codec.py --out benchmarks/results/optuna_codec.jsonl
    python benchmarks/optuna_codec.py --table benchmarks/results/optuna_codec.jsonl

Eight Voronoi cells, 40 parameters.  The optimizer gets features either from the encoder or from the
storage, with the same targets and seeds.  A second call does the missing runs.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from rows import Row, read, run_missing

import fide_tasks
from fide_adapters.optuna.images import ImageEvaluator
from fide_plugins import FIDE
from fide_plugins.recording.record import best_so_far

MARKS = (500, 1000, 2000)
SIZE = 112
CONFIGURATIONS = ("full", "stored")


def cells(seeds: int, targets: int) -> Iterator[Row]:
    """All runs, seeds outermost."""
    for seed in range(seeds):
        for target in range(targets):
            for configuration in CONFIGURATIONS:
                yield {"configuration": configuration, "target": target, "seed": seed}


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    return row["configuration"], row["target"], row["seed"]


def run(cell: Row) -> Row:
    """One run; its best losses at the marks."""
    task = fide_tasks.make("voronoi", size=SIZE, seed=cell["target"])
    optimizer = FIDE(task.dim, task.target, seed=cell["seed"])
    evaluator = ImageEvaluator(lambda: optimizer.evaluator)
    losses: list[float] = []
    while optimizer.evaluations < MARKS[-1]:
        X = optimizer.ask()
        images = task.render(X)
        told = [evaluator.loss(image[None]) for image in images]
        features = torch.stack([evaluator.tokens(image[None]) for image in images])
        if cell["configuration"] == "stored":
            stored = [evaluator.codec.unpack(evaluator.codec.pack(f)) for f in features]
            features = torch.stack([f for f in stored if f is not None])
        optimizer.tell(X, losses=told, features=features)
        losses += told
    best = best_so_far(losses)
    return {**cell, **{str(mark): float(best[mark - 1]) for mark in MARKS}}


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, default=Path("runs/optuna_codec.jsonl"))
    parser.add_argument("--table", type=Path)
    parser.add_argument("--targets", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    run_missing(cells(arguments.seeds, arguments.targets), run, arguments.out, key)


def table(rows: list[Row]) -> str:
    """Medians, and the mean ratio of pairs with its standard error, as Markdown."""
    found = {key(row): row for row in rows}
    pairs = [pair for name, *pair in found if name == "full" and ("stored", *pair) in found]
    lines = ["| trials | pairs | full | stored | stored / full |", "|---|---|---|---|---|"]
    for mark in map(str, MARKS):
        full, stored = (
            np.array([found[configuration, *pair][mark] for pair in pairs])
            for configuration in CONFIGURATIONS
        )
        ratio = np.log((stored + 1e-4) / (full + 1e-4))
        error = ratio.std(ddof=1) / np.sqrt(len(ratio))
        low, high = np.exp(ratio.mean() - error), np.exp(ratio.mean() + error)
        lines.append(
            f"| {mark} | {len(pairs)} | {np.median(full):.5f} | {np.median(stored):.5f} | "
            f"{np.exp(ratio.mean()):.2f} ({low:.2f} to {high:.2f}) |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
