"""Does a learned model find the camera of a new picture? San Miguel, few renders more.

    fide learn san_miguel --renders 100000 --size 32 --task-set spp=2 --task-set threads=1 \
        --passes 6 --out runs/san_miguel.fide
    python benchmarks/learned_camera.py --model runs/san_miguel.fide --targets 120-139
    python benchmarks/learned_camera.py --table

Or from nothing, one picture by itself; run directories are judged in the same way:

    fide run san_miguel --size 56 --spp 8 --task-set threads=1 --task-seed 140 --loss perceptual \
        --preset global --budget 60000 --out runs/global/140
    python benchmarks/learned_camera.py --runs runs/global/*

Every run (target, seed, configuration, size, samples, budget, loss) is one line of the output file,
appended when it is done; a second call does what is missing. What counts is the candidate with the
lowest loss when the budget is spent: how far its camera is from the truth, in units of the box, in
the worst of its parameters. Angles that wrap around are compared the shorter way.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from learned_beads import cells, key, kind_of
from moves import span
from numpy.typing import NDArray
from rows import Row, append, missing, read, report

import fide_tasks
from fide_plugins import FIDE
from fide_plugins.validation.options import parse_key_value

RESULTS = Path(__file__).parent / "results" / "learned_camera.jsonl"
NEAR = (0.005, 0.01, 0.02, 0.05)


def judge(directory: Path) -> Row:
    """Row of a run of `fide run`; its configuration is the preset."""
    record = json.loads((directory / "run.json").read_text())
    settings, totals = record["settings"], record["totals"]
    size, options = settings["size"][0], settings["task_options"]
    task: Any = fide_tasks.make(settings["task"], size, settings["task_seed"], **options)
    camera = [i for i, one in enumerate(task.parameters) if one.group == "camera"]
    periodic = np.array([one.periodic for one in task.parameters])
    apart = difference(np.array(totals["x_best"]), task.x_star, periodic)
    return {
        "scene": settings["task"], "target": settings["task_seed"], "seed": settings["seed"],
        "configuration": settings["options"].get("preset", settings["optimizer"]), "size": size,
        "spp": options["spp"], "budget": settings["budget"], "loss": settings["loss"],
        "best": totals["best_loss"], "apart": [round(a, 5) for a in apart.tolist()],
        "camera": float(apart[camera].max()), "wall_s": round(totals["wall_s"]),
        "load": record["load"],
    }  # fmt: skip


def measure(row: Row, model: str | None, options: dict[str, Any]) -> Row:
    """One run: how far the best camera is from the truth, and since which render it is near."""
    task: Any = fide_tasks.make(row["scene"], row["size"], row["target"], spp=row["spp"], threads=1)
    camera = [i for i, one in enumerate(task.parameters) if one.group == "camera"]
    periodic = np.array([one.periodic for one in task.parameters])
    opt = FIDE(
        task.space, task.target, loss=row["loss"], learned=model, seed=row["seed"], **options
    )
    best, far = np.inf, []
    apart = np.ones(task.dim)
    first: float | None = None
    while opt.evaluations < row["budget"]:
        X = opt.ask()[: row["budget"] - opt.evaluations]
        before = opt.evaluations
        losses = opt.tell(X, task.render(X, seed=list(range(before, before + len(X)))))
        for x, value in zip(X, losses.tolist(), strict=True):
            if value < best:
                best, apart = value, difference(x, task.x_star, periodic)
            far.append(float(apart[camera].max()))
        if first is None and model is not None:
            first = min(float(difference(x, task.x_star, periodic)[camera].max()) for x in X)
    return {
        **row,
        "best": best,
        "apart": [round(a, 5) for a in apart.tolist()],
        "camera": far[-1],
        "nearest_hypothesis": first,
        "near_since": {str(near): since(far, near) for near in NEAR},
    }


def difference(
    x: NDArray[np.float64], y: NDArray[np.float64], periodic: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Distance (d,) of two points (d,) of the cube in each parameter."""
    apart = np.abs(x - y)
    return np.where(periodic, np.minimum(apart, 1 - apart), apart)


def since(far: list[float], near: float) -> int | None:
    """Number of the render from which on the best one was as near; None if the last is not."""
    outside = np.flatnonzero(np.array(far) > near)
    if not len(outside):
        return 1
    return None if outside[-1] == len(far) - 1 else int(outside[-1]) + 2


def table(rows: list[Row]) -> str:
    """Pictures whose camera was found, in Markdown."""
    lines = ["| scene | configuration | renders | " + " | ".join(f"within {n}" for n in NEAR)]
    lines[0] += " | median of renders until 0.01 |"
    lines.append("|---|---|" + "---:|" * (len(NEAR) + 2))
    for kind in dict.fromkeys(map(kind_of, rows)):
        group = [r for r in rows if kind_of(r) == kind]
        counts = [sum(r["camera"] <= near for r in group) for near in NEAR]
        at = [r["near_since"]["0.01"] or np.inf for r in group if "near_since" in r]
        cells = " | ".join(f"{count} of {len(group)}" for count in counts)
        until = f"{np.median(at):.0f}" if at else "-"
        lines.append(f"| {kind[0]} | {kind[1]} | {kind[2]:,} | {cells} | {until} |")
    return "\n".join(lines)


def main() -> None:
    """Do what is asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default="san_miguel")
    parser.add_argument("--model", help="file of a model; without it the search has none")
    parser.add_argument("--targets", type=span, default=range(120, 140), metavar="A-B")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, default=56)
    parser.add_argument("--spp", type=int, default=8)
    parser.add_argument("--budget", type=int, default=500)
    parser.add_argument("--loss", default="perceptual")
    parser.add_argument(
        "--configuration", nargs="+", default=["learned"], metavar="NAME [KEY=VALUE]"
    )
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--runs", nargs="+", type=Path, metavar="DIR", help="judge these")
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.out)))
        return
    if arguments.runs:
        add(missing(map(judge, arguments.runs), arguments.out, key), arguments.out)
        return
    torch.set_num_threads(1)
    name, *pairs = arguments.configuration
    options = dict(parse_key_value(pair) for pair in pairs)
    left = missing(cells(arguments, name), arguments.out, key)
    add((measure(row, arguments.model, options) for row in left), arguments.out)


def add(rows: Iterable[Row], out: Path) -> None:
    """Add rows to the file as they come, and show them."""
    for row in rows:
        append(out, row)
        report(row)


if __name__ == "__main__":
    main()
