"""Does `preset="global"` find one hard picture? At equal numbers of renders.

    python benchmarks/global_preset.py robot --targets 420-422
    python benchmarks/global_preset.py --table

Every run (scene, target, preset) is one line of benchmarks/results/global_preset.jsonl, appended
when it is done; a second call does what is missing. Scenes, and the loss at which each is solved,
are those of moves.py. Times are CPU times of this process, renders included.
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
from moves import SCENES, span
from rows import Row, read, run_missing

import fide_tasks
from fide_lab import run as harness

RESULTS = Path(__file__).parent / "results" / "global_preset.jsonl"


def cells(arguments: argparse.Namespace) -> Iterator[Row]:
    """All runs, targets outermost."""
    for target in arguments.targets:
        for scene in arguments.scenes:
            for preset in arguments.presets:
                yield {
                    "scene": scene, "target": target, "preset": preset, "budget": arguments.budget
                }  # fmt: skip


def key(row: Row) -> tuple[Any, ...]:
    """What makes a run."""
    return row["scene"], row["target"], row["preset"], row["budget"]


def measure(cell: Row) -> Row:
    """One run: when it was solved, its best loss, and what it took."""
    scene = SCENES[cell["scene"]]
    task = fide_tasks.make(scene.task, scene.size, cell["target"], **scene.options)
    start = time.process_time()
    result = harness.run(task, "fide", "mse", cell["budget"], 0, options={"preset": cell["preset"]})
    solved = np.flatnonzero(result.losses <= scene.solved)
    return {
        **cell,
        "solved_at": int(solved[0]) + 1 if len(solved) else None,
        "best": result.best_loss,
        "cpu_s": round(time.process_time() - start, 1),
    }


def table(rows: list[Row]) -> str:
    """Runs solved, losses and times, in Markdown."""
    lines = ["| scene | preset | renders | solved | median of the best loss | CPU time |"]
    lines.append("|---|---|---:|---:|---:|---:|")
    for kind in dict.fromkeys((row["scene"], row["preset"], row["budget"]) for row in rows):
        group = [row for row in rows if (row["scene"], row["preset"], row["budget"]) == kind]
        solved = sum(row["solved_at"] is not None for row in group)
        loss, seconds = (float(np.median([row[k] for row in group])) for k in ("best", "cpu_s"))
        lines.append(
            f"| {kind[0]} | {kind[1]} | {kind[2]:,} | {solved} of {len(group)} | {loss:.2g} | "
            f"{seconds:.0f} s |"
        )
    return "\n".join(lines)


def main() -> None:
    """Do what is asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(SCENES))
    parser.add_argument("--targets", type=span, default=range(420, 423), metavar="A-B")
    parser.add_argument("--presets", nargs="+", default=["global", "balanced"], metavar="PRESET")
    parser.add_argument("--budget", type=int, default=10_000)
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    run_missing(cells(arguments), measure, arguments.out, key)
    if arguments.table:
        print(table(read(arguments.out)))


if __name__ == "__main__":
    main()
