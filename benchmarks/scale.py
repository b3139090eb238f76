"""Time and memory of a generation with many parameters, candidates, pixels; with exponents.

    python benchmarks/scale.py dim popsize size         # the missing measurements of these rows
    python benchmarks/scale.py network tokens           # the network: by parameters, image tokens
    python benchmarks/scale.py table

Each measurement has a process of its own, for its maximum resident set size, and is one line of the
results; a second call does the missing ones.  The renderer is a linear map to 8 x 8 colors, which
takes almost no time.  Times are CPU times, one thread, without rendering: the mean of eight
generations after the buffer of the linear proposer is full.  Several are needed, since with many
parameters the covariance is decomposed only in one of several generations.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from profile_generation import PARTS, Stopwatch, overhead, watched
from rows import Row, append, missing, provenance, read, report

RESULTS = Path(__file__).parent / "results" / "scale.jsonl"
BASE = {"dim": 40, "popsize": 50, "size": 112}
ROWS: dict[str, list[dict[str, Any]]] = {
    "dim": [{"dim": d} for d in (10, 25, 50, 100, 200, 400, 1000)],
    "popsize": [{"popsize": k} for k in (50, 150, 500, 1500, 5000)],
    "size": [{"size": s} for s in (64, 128, 256, 512, 1024)],
    "network": [
        {"dim": d, "preset": "paper", "epochs": 1, "parameter_tokens": n}
        for n in (None, 16)
        for d in (10, 50, 100, 200, 400)
    ],
    "tokens": [{"size": s, "preset": "paper", "epochs": 1} for s in (64, 112, 224, 448)],
}
REMEMBERED = 600  # candidates, at most
GENERATIONS = {"balanced": 8, "paper": 2}


class Patchwork:
    """Colors of 8 x 8 squares, a random linear function of the parameters."""

    def __init__(self, dim: int, size: int) -> None:
        self.map = np.random.default_rng(0).standard_normal((dim, 192)) / np.sqrt(dim)
        self.size = size
        self.target = self.render(np.random.default_rng(1).random((1, dim)))[0]

    def render(self, X: Any) -> Any:
        colors = np.clip(0.5 + (X - 0.5) @ self.map, 0, 1).astype(np.float32)
        side = -(-self.size // 8)
        squares = colors.reshape(len(X), 8, 8, 3).repeat(side, axis=1).repeat(side, axis=2)
        return squares[:, : self.size, : self.size]


def measure(cell: Row) -> Row:
    """Milliseconds of a generation by part, and the largest resident set, MB."""
    import torch

    from fide_plugins import FIDE

    torch.set_num_threads(1)
    settings = {**BASE, **cell}
    dim, size = settings.pop("dim"), settings.pop("size")
    preset = settings.setdefault("preset", "balanced")
    task = Patchwork(dim, size)
    if preset == "paper":
        settings["overlap"] = False
    opt = FIDE(dim, task.target, seed=0, device="cpu", guard_images=False, **settings)
    popsize = settings["popsize"]
    for _ in range(-(-REMEMBERED // popsize) if preset == "balanced" else 1):
        generation(opt, task, Stopwatch())
    watch, n = Stopwatch(), GENERATIONS[preset]
    undo = watched(opt, watch)
    for _ in range(n):
        generation(opt, task, watch)
    for step in undo:
        step()
    ms = {part: 1e3 * s / n for part, s in watch.seconds.items()}
    return {"ms": ms, "MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


def generation(opt: Any, task: Patchwork, watch: Stopwatch) -> None:
    with watch.part("rest"):
        X = opt.ask()
    for some in np.array_split(X, -(-len(X) // 100)):  # images of at most 100 at a time
        with watch.part("render"):
            images = task.render(some)
        with watch.part("rest"):
            opt.tell(some, images)


def planned(rows: list[str]) -> Iterator[Row]:
    for name in rows:
        for cell in ROWS[name]:
            yield {"cell": {"row": name, **cell}}


def key(row: Row) -> frozenset[Any]:
    return frozenset(row["cell"].items())


def measure_apart(planned_run: Row) -> tuple[Row, Row]:
    """A measurement in a process of its own, and the provenance of that process."""
    cell = {name: value for name, value in planned_run["cell"].items() if name != "row"}
    words = [sys.executable, __file__, "cell", json.dumps(cell)]
    answer = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    found, made_by = json.loads(answer.splitlines()[-1])
    return {**planned_run, **found}, made_by


def table(rows: list[Row]) -> str:
    """A line a cell, and the exponent from the cell before."""
    parts = [part for part in PARTS if part != "render"]
    lines = [f"| | {' | '.join(parts)} | ms a generation | exponent | MB |"]
    lines.append("|---|" + "---|" * (len(parts) + 3))
    before: tuple[Any, float, float] | None = None
    for row in rows:
        cell, ms = dict(row["cell"]), row["ms"]
        name = cell.pop("row")
        varied = {"network": "dim", "tokens": "size"}.get(name, name)
        kind = (name, cell.get("parameter_tokens"))
        x, total = cell[varied], overhead(ms)
        if name == "tokens":  # of 16 x 16 pixels each
            x = (x // 16) ** 2
        slope = ""
        if before is not None and before[0] == kind and x > before[1]:
            slope = f"{np.log(total / before[2]) / np.log(x / before[1]):.2f}"
        before = (kind, x, total)
        label = ", ".join(f"{k} {v}" for k, v in cell.items() if k not in ("preset", "epochs"))
        label += f", {x} tokens" if name == "tokens" else ""
        shown = " | ".join(f"{ms[part]:.1f}" for part in parts)
        lines.append(f"| {name}: {label} | {shown} | {total:.1f} | {slope} | {row['MB']:.0f} |")
    return "\n".join(lines)


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("what", nargs="+", metavar="ROW")
    what = parser.parse_args().what
    if what[0] == "cell":
        print(json.dumps([measure(json.loads(what[1])), provenance()]))
    elif what == ["table"]:
        print(table(read(RESULTS)))
    elif set(what) <= set(ROWS):
        for run in missing(planned(what), RESULTS, key):
            row, made_by = measure_apart(run)
            append(RESULTS, row, made_by=made_by)
            report(row)
    else:
        parser.error(f"rows are {', '.join(ROWS)}; or table")


if __name__ == "__main__":
    main()
