"""Are learned models as sure as they may be? Their regions, judged on pictures that none has seen.

    fide learn robot --renders 100000 --size 64 --passes 5 --out runs/robot.fide
    python benchmarks/calibration.py robot --model runs/robot.fide
    python benchmarks/calibration.py --table

Each scene has 500 renders of parameters from a seed of this script, of the size that the model has
learned: they were not learned from, nor did they choose when to stop or the scale of the density. A
picture's region of share p is where the density is above that of all but p of 99 hypotheses. Each
model is judged as it is, and without the scale that was fitted after training. Every judgment is
one line of the output file; a second call does what is missing.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from numpy.typing import NDArray
from rows import Row, append, missing, read, report

import fide_tasks
from fide_plugins.learning.model import Model
from fide_plugins.learning.networks import Network, as_input
from fide_plugins.learning.renders import as_renderer
from fide_plugins.validation import key_value

RESULTS = Path(__file__).parent / "results" / "calibration.jsonl"
SHARES = (0.5, 0.8, 0.9, 0.95)
GOAL = (0.85, 0.95)  # of the region of 90 %
_SEED, _HYPOTHESES, _TOGETHER = 777_002, 99, 100


def pictures(model: Model, scene: str, options: Row, n: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Fresh parameters (n, d), and their images (n, H, W, 3) of the size that the model sees."""
    renderer = as_renderer(fide_tasks.make(scene, max(model.size), 0, **options), None)
    x = np.random.default_rng(_SEED).random((n, renderer.dim))
    parts: list[Any] = [
        renderer.small(x[i : i + _TOGETHER], range(i, min(n, i + _TOGETHER)), model.size)
        for i in range(0, n, _TOGETHER)
    ]
    return x, np.concatenate(parts)


@torch.no_grad()
def above(network: Network, x: NDArray[Any], images: NDArray[Any]) -> tuple[list[float], float]:
    """Of each picture the share of hypotheses denser than the truth, and the mean log-density."""
    generator = torch.Generator().manual_seed(0)
    u = torch.from_numpy(x.astype(np.float32))
    found, nats = [], []
    for i in range(len(x)):
        image = as_input(images[i : i + 1])
        drawn = network.sample(image, _HYPOTHESES, generator)
        density = network.log_prob(image, torch.cat([u[i : i + 1], drawn])).numpy()
        found.append(float((density[1:] > density[0]).mean()))
        nats.append(float(density[0]))
    return found, float(np.mean(nats))


def key(row: Row) -> tuple[Any, ...]:
    """What makes a judgment."""
    return row["scene"], row["model"], row["scaled"], row["pictures"]


def measure(row: Row, model: Model, x: NDArray[Any], images: NDArray[Any]) -> Row:
    """Share of pictures whose truth is in each region; without the fitted scale unless `scaled`."""
    fitted, start = model.network.scale, time.process_time()
    scale = fitted if row["scaled"] else 1.0
    model.network.scale = scale
    shares, nats = above(model.network, x, images)
    model.network.scale = fitted
    return {
        **row,
        "renders": model.report.renders,
        "passes": len(model.report.curve),
        "augment": model.report.augment,
        "size": max(model.size),
        "scale": round(scale, 3),
        "nats": round(nats, 2),
        "coverage": {str(p): round(float(np.mean(np.array(shares) < p)), 3) for p in SHARES},
        "reported": model.report.coverage,
        "cpu_s": round(time.process_time() - start, 1),
    }


def table(rows: list[Row]) -> str:
    """All judgments, in Markdown."""
    lines = [
        "| scene | renders, passes | scale | nats | "
        + " | ".join(f"{p:.0%} region" for p in SHARES)
        + " | as wanted |"
    ]
    lines.append("|---|---|---:|---:|" + "---:|" * len(SHARES) + "---|")
    for row in rows:
        cells = " | ".join(f"{row['coverage'][str(p)]:.1%}" for p in SHARES)
        reached = GOAL[0] <= row["coverage"]["0.9"] <= GOAL[1]
        lines.append(
            f"| {row['scene']} | {row['renders']:,}, {row['passes']} | "
            f"{row['scale'] if row['scaled'] else '-'} | {row['nats']:.2f} | {cells} | "
            f"{'yes' if reached else 'no'} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Do what is asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", default="robot", help="a built-in task")
    parser.add_argument("--model", help="file of a model of this task")
    parser.add_argument("--name", help="of the model in the table (its file's)")
    parser.add_argument("--task-set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--pictures", type=int, default=500)
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.out)))
        return
    if arguments.model is None:
        parser.error("--model names the file to judge")
    torch.set_num_threads(1)
    model = Model.load(arguments.model)
    name = arguments.name or Path(arguments.model).stem
    kinds = [False, True] if model.report.fitted else [False]
    about = {"scene": arguments.scene, "model": name, "pictures": arguments.pictures}
    left = list(missing(({**about, "scaled": scaled} for scaled in kinds), arguments.out, key))
    if not left:
        return
    options = dict(key_value.parse(pair) for pair in arguments.task_set)
    x, images = pictures(model, arguments.scene, options, arguments.pictures)
    for row in left:
        found = measure(row, model, x, images)
        append(arguments.out, found)
        report(found)


if __name__ == "__main__":
    main()
