"""Pictures that the renderer did not quite draw: poses found with `photo=True`, and without.

    python benchmarks/gap.py --targets 720-729 --out runs/gap.jsonl
    python benchmarks/gap.py --table benchmarks/results/gap.jsonl

The clean target of robot and arm gets another exposure, a shading, an occluder, or the blur, noise
and JPEG of a camera.  A pose is found if the clean render of the answer differs from the clean
target by less than a hundredth of what random renders do: not the loss that was minimized judges.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from moves import span
from rows import Row, read, run_missing

import fide_tasks
from fide_lab.suite.foreign import GAPS as CHANGES, changed, clean_error
from fide_plugins import FIDE

SCENES = "robot", "arm"
GAPS = "clean", *CHANGES
BUDGET, SIZE = 1500, 64
FOUND = 0.01
ARMS: dict[str, dict[str, Any]] = {"photo": {"photo": True}, "default": {}}


def planned_runs(arguments: argparse.Namespace) -> Iterator[Row]:
    """All runs, targets outermost."""
    for target in arguments.targets:
        for scene in SCENES:
            for gap in GAPS:
                for arm in arguments.arms:
                    yield {"scene": scene, "gap": gap, "target": target, "arm": arm}


def run(planned: Row) -> Row:
    """One run: its error, and what is said of it."""
    seed = planned["target"]
    task: Any = fide_tasks.make(planned["scene"], size=SIZE, seed=seed)
    picture = changed(task.target, planned["gap"], np.random.default_rng(7 * seed + 1))
    search = FIDE(task.dim, picture, seed=seed, **ARMS[planned["arm"]])
    while search.evaluations < BUDGET:
        x = search.ask_ready()
        search.tell(x, task.render(x))
    best = search.best
    assert best is not None
    return {**planned, "error": clean_error(task)(best.x), "status": search.status.code}


def table(rows: list[Row]) -> str:
    """Found of how many, by scene and gap."""
    lines = ["| scene | gap | " + " | ".join(ARMS) + " |", "|---|---|" + "---|" * len(ARMS)]
    found: Counter[tuple[str, ...]] = Counter()
    total: Counter[tuple[str, ...]] = Counter()
    for row in rows:
        cell = row["scene"], row["gap"], row["arm"]
        total[cell] += 1
        found[cell] += row["error"] < FOUND
    for scene in SCENES:
        for gap in GAPS:
            cells = [(scene, gap, arm) for arm in ARMS]
            shown = [f"{found[cell]} of {total[cell]}" if total[cell] else "-" for cell in cells]
            lines.append(f"| {scene} | {gap} | {' | '.join(shown)} |")
    return "\n".join(lines)


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--targets", type=span, default=range(720, 730), metavar="A-B")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--out", type=Path, default=Path("runs/gap.jsonl"))
    parser.add_argument("--table", type=Path)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    run_missing(
        planned_runs(arguments),
        run,
        arguments.out,
        lambda row: (row["scene"], row["gap"], row["target"], row["arm"]),
    )


if __name__ == "__main__":
    main()
