"""How fast does `learn` learn? Held-out likelihood after each pass, by the size of a batch.

    python benchmarks/learned_training.py robot --size 64 --renders 20000 --passes 3
    python benchmarks/learned_training.py voronoi --size 32 --renders 40000 --passes 1
    python benchmarks/learned_training.py --table

Every training (scene, size, renders, passes, batch) is one line of the output file, appended when
it is done; a second call does what is missing. Times are CPU times of training alone.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from moves import read
from numpy.typing import NDArray

import fide_tasks
from fide_plugins.learning.learn import kind_of
from fide_plugins.learning.network import Network
from fide_plugins.learning.renderer import as_renderer
from fide_plugins.learning.training import Training

RESULTS = Path(__file__).parent / "results" / "learned_training.jsonl"
_KEY = ("scene", "size", "renders", "passes", "batch")
_SEED = 12345
_TOGETHER = 500  # renders

Row = dict[str, Any]


def rendered(scene: str, size: int, n: int) -> tuple[Any, NDArray[np.float64], NDArray[np.uint8]]:
    """Renderer of a task, random parameters (n, d), and their images (n, size, size, 3)."""
    renderer = as_renderer(fide_tasks.make(scene, size, 0), None)
    x = np.random.default_rng(_SEED).random((n, renderer.dim))
    images = np.empty((n, size, size, 3), np.uint8)
    for first in range(0, n, _TOGETHER):
        some = x[first : first + _TOGETHER]
        images[first : first + len(some)] = renderer.small(some, range(len(some)), (size, size))
    return renderer, x, images


def measure(row: Row, renderer: Any, x: NDArray[np.float64], images: NDArray[np.uint8]) -> Row:
    """One training."""
    head, blocks = kind_of(renderer, None, None)
    periodic = tuple(bool(each) for each in renderer.space.periodic)
    network = Network((row["size"], row["size"]), periodic, head, blocks, 0)
    training = Training(network, x, images, row["passes"], 0, batch=row["batch"])
    start = time.process_time()
    training.run()
    return {
        **row,
        "head": head,
        "nats": [round(-test, 2) for _, _, test in training.curve],
        "cpu_s": round(time.process_time() - start, 1),
    }


def table(rows: list[Row]) -> str:
    """All trainings, in Markdown."""
    lines = ["| scene | renders | batch | held-out nats, pass by pass | CPU time |"]
    lines.append("|---|---:|---:|---|---:|")
    for row in rows:
        nats = ", ".join(f"{n:.2f}" for n in row["nats"])
        lines.append(
            f"| {row['scene']}, {row['size']} px | {row['renders']:,} | {row['batch']} | {nats} | "
            f"{row['cpu_s']:.0f} s |"
        )
    return "\n".join(lines)


def main() -> None:
    """Do what is asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", default="robot", help="a built-in task")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--renders", type=int, default=20_000)
    parser.add_argument("--passes", type=int, default=3)
    parser.add_argument("--batch", type=int, nargs="+", default=[32, 128])
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.out)))
        return
    torch.set_num_threads(1)
    about = {name: getattr(arguments, name) for name in ("scene", "size", "renders", "passes")}
    planned = [{**about, "batch": batch} for batch in arguments.batch]
    done = {tuple(row[name] for name in _KEY) for row in read(arguments.out)}
    missing = [row for row in planned if tuple(row[name] for name in _KEY) not in done]
    if not missing:
        return
    made = rendered(arguments.scene, arguments.size, arguments.renders)
    for row in missing:
        found = measure(row, *made)
        with arguments.out.open("a") as file:
            file.write(json.dumps(found) + "\n")
        print(found, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
