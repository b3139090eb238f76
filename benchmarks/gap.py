"""Pictures that the renderer did not quite draw: poses found with `photo=True`, and without.

    python benchmarks/gap.py --targets 720-729 --out runs/gap.jsonl
    python benchmarks/gap.py --targets 720-739 --arms learned --model robot.fide
    python benchmarks/gap.py --table benchmarks/results/gap.jsonl

The model: `learn(task, renders=150_000, size=64, passes=8, clutter=True, out="robot.fide")` with
`task = fide_tasks.make("robot", size=64)`.  With it there are 500 renders, of robot alone.

The clean target of robot and arm gets another exposure, a shading, an occluder, or the blur, noise
and JPEG of a camera.  A pose is found if the clean render of the answer differs from the clean
target by less than a hundredth of what random renders do: not the loss that was minimized judges.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Iterator
from functools import partial
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
BUDGETS, SIZE = {"photo": 1500, "default": 1500, "learned": 500}, 64
FOUND = 0.01
ARMS: dict[str, dict[str, Any]] = {
    "photo": {"photo": True},
    "default": {},
    "learned": {"photo": True},
}


def planned_runs(arguments: argparse.Namespace) -> Iterator[Row]:
    """All runs, targets outermost."""
    for target in arguments.targets:
        for scene in SCENES:
            for gap in GAPS:
                for arm in arguments.arms:
                    if arm != "learned" or scene == "robot":
                        yield {"scene": scene, "gap": gap, "target": target, "arm": arm}


def run(planned: Row, model: str | None = None) -> Row:
    """One run: its error, and what is said of it.  model: file of the arm `learned`."""
    seed = planned["target"]
    task: Any = fide_tasks.make(planned["scene"], size=SIZE, seed=seed)
    picture = changed(task.target, planned["gap"], np.random.default_rng(7 * seed + 1))
    options, learned = ARMS[planned["arm"]], planned["arm"] == "learned"
    search = FIDE(task.dim, picture, seed=seed, learned=model if learned else None, **options)
    while search.evaluations < BUDGETS[planned["arm"]]:
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
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=["photo", "default"])
    parser.add_argument("--model")
    parser.add_argument("--out", type=Path, default=Path("runs/gap.jsonl"))
    parser.add_argument("--table", type=Path)
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    run_missing(
        planned_runs(arguments),
        partial(run, model=arguments.model),
        arguments.out,
        lambda row: (row["scene"], row["gap"], row["target"], row["arm"]),
    )


if __name__ == "__main__":
    main()
