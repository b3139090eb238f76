"""How fast does `learn` learn? Held-out likelihood after each pass, by the size of a batch.

    python benchmarks/learned_training.py robot --size 64 --renders 20000 --passes 3
    python benchmarks/learned_training.py voronoi --size 32 --renders 40000 --passes 1
    python benchmarks/learned_training.py robot --size 64 --renders 10000 --cpu-seconds 60 \
        --heads autoregressive mixture
    python benchmarks/learned_training.py --table

Every training (scene, size, renders, passes or seconds, batch, head) is one line of the output
file, appended when it is done; a second call does what is missing. Times are CPU times of training
alone. With --cpu-seconds each head trains for as long, whatever the number of passes, and is judged
on 500 more renders. Renders come from the store --store, with what is missing there, or are made.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from numpy.typing import NDArray
from rows import Row, append, read, report, rows_of

import fide_tasks
from fide_plugins.learning.judging import Distance, judge
from fide_plugins.learning.networks import Network, as_input
from fide_plugins.learning.pipeline import kind_of
from fide_plugins.learning.renders import RenderStore, as_renderer
from fide_plugins.learning.training import Training
from fide_plugins.space import Space

RESULTS = Path(__file__).parent / "results" / "learned_training.jsonl"
_KEY = ("scene", "size", "renders", "passes", "batch", "cpu_limit", "head")
_SEED = 12345
_TOGETHER = 500  # renders
_JUDGES = 500  # renders more that judge heads
_HYPOTHESES, _PICTURES = 50, 10  # whose time is taken
_SHOWN = {"robot": (0, 1, 3), "san_miguel": (0, 1, 2, 3, 4)}
"""Axes by which hypotheses of any head are judged: what images show most, other scenes: all."""

Renders = tuple[Space, NDArray[np.float64], NDArray[np.uint8]]


def rendered(scene: str, size: int, n: int) -> Renders:
    """Space of a task, random parameters (n, d), and their images (n, size, size, 3)."""
    renderer = as_renderer(fide_tasks.make(scene, size, 0), None)
    assert renderer.space is not None
    x = np.random.default_rng(_SEED).random((n, renderer.dim))
    images = np.empty((n, size, size, 3), np.uint8)
    for first in range(0, n, _TOGETHER):
        some = x[first : first + _TOGETHER]
        small: list[Any] = renderer.small(some, range(len(some)), (size, size))
        images[first : first + len(some)] = small
    return renderer.space, x, images


def stored(folder: Path, size: int, n: int) -> Renders:
    """The same of the first n renders that `fide learn` has kept in a folder."""
    store = RenderStore.open(folder)
    x, images = store.read(n)
    if len(x) < n or max(store.size) != size:
        sys.exit(f"{folder} has {len(x)} renders of {max(store.size)} pixels, not {n} of {size}")
    return Space.from_dict(store.settings["space"]), x, images


class Timed(Training):
    """Training with a clock of CPU time, which stands still during checks on held-out renders."""

    checks = 0.0

    def clock(self) -> float:
        """CPU seconds of this process without checks."""
        return time.process_time() - self.checks

    def test(self) -> float:
        """See `Training`."""
        start = time.process_time()
        found = super().test()
        self.checks += time.process_time() - start
        return found


def measure(row: Row, made: Renders) -> Row:
    """One training; of heads at equal cost also what they say of renders that were set aside."""
    space, x, images = made
    head, blocks = kind_of(as_renderer(np.zeros_like, space), None, row["head"])
    periodic = tuple(bool(each) for each in space.periodic)
    n, limit = row["renders"], row["cpu_limit"]
    network = Network(images.shape[1:3], periodic, head, blocks, 0)
    learner = Timed(network, x[:n], images[:n], row["passes"], 0, seconds=limit, batch=row["batch"])
    start = learner.clock()
    with patch.object(time, "monotonic", learner.clock):
        learner.run()
    found = {
        **row,
        "head": head,
        "nats": [round(-test, 2) for _, _, test in learner.curve],
        "seen": int(learner.curve[-1][0]),
        "cpu_s": round(learner.clock() - start, 1),
        "checks_s": round(learner.checks, 1),
    }
    if limit is None:
        return found
    return found | judged(network, made, blocks, row)


def judged(network: Network, made: Renders, blocks: Any, row: Row) -> Row:
    """What a network says of renders from which it has not learned."""
    space, x, images = made
    n, shown = row["renders"], _SHOWN.get(row["scene"])
    network.eval()
    distance = Distance(np.array(space.periodic), blocks)
    start = time.process_time()
    with torch.no_grad():
        u = torch.from_numpy(x[n:].astype(np.float32))
        each = network.log_prob(as_input(images[n:]), u)
    density = time.process_time() - start
    names = [name for name, axes in space.axes.items() for _ in axes]
    few = slice(n, n + row["pictures"])
    found = judge(network, x[few], images[few], names, distance)
    generator = torch.Generator().manual_seed(0)
    near = [
        nearest(network, image, truth, shown, distance, generator)
        for image, truth in zip(images[few], x[few], strict=True)
    ]
    start = time.process_time()
    for i in range(_PICTURES):
        network.sample(as_input(images[n + i : n + i + 1]), _HYPOTHESES, generator)
    return {
        "judged_nats": round(float(each.mean()), 2),
        "standard_error": round(float(each.std()) / len(each) ** 0.5, 2),
        "median_nats": round(float(each.median()), 2),
        "near": [float(np.mean(np.array(near) <= radius)) for radius in (0.05, 0.1)],
        "coverage": found.coverage,
        "ranks": [round(rank, 2) for rank in found.ranks],
        "unseen": list(found.unseen),
        "sample_50_s": round((time.process_time() - start) / _PICTURES, 4),
        "density_500_s": round(density, 3),
    }


def nearest(
    network: Network,
    image: NDArray[np.uint8],
    truth: NDArray[np.float64],
    shown: tuple[int, ...] | None,
    distance: Distance,
    generator: torch.Generator,
) -> float:
    """Distance of the nearest of 64 hypotheses from the truth, in the axes `shown`; None: all."""
    samples = network.sample(as_input(image[None]), 64, generator).numpy().astype(np.float64)
    if shown is not None:
        others = np.setdiff1d(np.arange(len(truth)), shown)
        samples[:, others] = truth[others]
    return float(distance(samples, truth).min())


def table(rows: list[Row]) -> str:
    """All trainings, in Markdown."""
    lines = ["| scene | renders | batch | held-out nats, pass by pass | CPU time |"]
    lines.append("|---|---:|---:|---|---:|")
    for row in rows:
        if row.get("cpu_limit") is None:
            nats = ", ".join(f"{n:.2f}" for n in row["nats"])
            lines.append(
                f"| {row['scene']}, {row['size']} px | {row['renders']:,} | {row['batch']} | {nats}"
                f" | {row['cpu_s']:.0f} s |"
            )
    heads = [row for row in rows if row.get("cpu_limit") is not None]
    return "\n".join([*lines, "", *_heads(heads)])


def _heads(rows: list[Row]) -> list[str]:
    """Heads at equal cost."""
    lines = ["| scene | head | passes | nats | within 0.1 | 0.05 | 90 % region | 50 hypotheses |"]
    lines.append("|---|---|---:|---:|---:|---:|---:|---:|")
    for row in rows:
        near, nearer = row["near"][::-1]
        lines.append(
            f"| {row['scene']} | {row['head']} | {row['seen'] / row['renders']:.1f} | "
            f"{row['judged_nats']:.2f} | {near:.2f} | {nearer:.2f} | {row['coverage']:.2f} | "
            f"{1000 * row['sample_50_s']:.0f} ms |"
        )
    return lines


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
    parser.add_argument(
        "--heads", nargs="+", help="see fide_plugins.learning.networks.HEADS"
    )
    parser.add_argument("--cpu-seconds", type=float, help="of each training; many passes, batch 32")
    parser.add_argument("--pictures", type=int, default=100, help="judged by hypotheses (100)")
    parser.add_argument("--store", type=Path, help="folder of renders that fide learn has kept")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    if arguments.table:
        print(table(read(arguments.out)))
        return
    torch.set_num_threads(1)
    planned = plan(arguments)
    done = rows_of(arguments.out)
    left = [row for row in planned if not any(_same(row, there) for there in done)]
    if not left:
        return
    number = arguments.renders + (0 if arguments.cpu_seconds is None else _JUDGES)
    if arguments.store is None:
        made = rendered(arguments.scene, arguments.size, number)
    else:
        made = stored(arguments.store, arguments.size, number)
    for row in left:
        found = measure(row, made)
        append(arguments.out, found)
        report(found)


def plan(arguments: argparse.Namespace) -> list[Row]:
    """Rows that are asked for, without results."""
    about = {name: getattr(arguments, name) for name in ("scene", "size", "renders", "passes")}
    about |= {"cpu_limit": arguments.cpu_seconds, "pictures": arguments.pictures}
    batches = arguments.batch
    if arguments.cpu_seconds is not None:
        about["passes"], batches = 1000, [32]
    heads = arguments.heads or [None]
    return [{**about, "batch": batch, "head": head} for batch in batches for head in heads]


def _same(asked: Row, there: Row) -> bool:
    """Whether a row that is asked for, without a head the usual one, is there."""
    names = [name for name in _KEY if name != "head" or asked["head"] is not None]
    return all(asked[name] == there.get(name) for name in names)


if __name__ == "__main__":
    main()
