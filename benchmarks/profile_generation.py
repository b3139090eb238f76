"""Where the time of a generation goes, and how close training comes to the CPU's peak.

    python benchmarks/profile_generation.py parts voronoi spline --presets balanced fast paper
    python benchmarks/profile_generation.py training
    python benchmarks/profile_generation.py kernels     # the operators of a training step
    python benchmarks/profile_generation.py ways        # threads, batches, compiled or not
    python benchmarks/profile_generation.py table       # of the recorded measurements

Times are CPU times, one thread, so that other programs affect them little.  The time of each part
excludes the parts that it calls.  Every measurement is a line of the file `--out`.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from rows import Row, append, read
from torch.utils.flop_counter import FlopCounterMode

import fide_tasks
from fide_plugins import FIDE
from fide_plugins.proposers.diffusion import DiffusionProposer
from fide_plugins.search.cma_es import CMAES

RESULTS = Path(__file__).parent / "results" / "profile.jsonl"
PARTS = ("render", "loss", "encode", "train", "sample", "search", "copy", "rest")
TRAINING: dict[str, dict[str, Any]] = {
    "as published, 112": {"T": 49, "C": 768},
    "as published, 224": {"T": 196, "C": 768},
    "dense tokens": {"T": 196, "C": 16},
    "as published, 112, batch 250": {"T": 49, "C": 768, "batch_size": 250},
}
DIM, EXAMPLES = 40, 500
KINDS = {
    "products": ("aten::mm", "aten::addmm", "aten::bmm", "aten::linear"),
    "attention": ("attention",),
    "normalization": ("layer_norm",),
    "Adam": ("adam", "Optimizer"),
    "sums over examples": ("aten::sum", "aten::mean"),
    "gelu, silu": ("gelu", "silu"),
    "elementwise": ("aten::mul", "aten::add_", "aten::add", "aten::div", "aten::sub", "aten::neg"),
    "copies": ("copy_", "aten::cat", "aten::index", "fill_", "zero_", "clone", "slice_backward"),
}
"""Kinds of operators, and what their names contain; the first kind that fits."""


Shape = Sequence[int]  # (batch, heads, tokens, channels)


class Stopwatch:
    """CPU time by part; a part that calls another stands still meanwhile."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(PARTS, 0.0)
        self._running: list[str] = []
        self._since = 0.0

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        self._note()
        self._running.append(name)
        try:
            yield
        finally:
            self._note()
            self._running.pop()

    def _note(self) -> None:
        now = time.process_time()
        if self._running:
            self.seconds[self._running[-1]] += now - self._since
        self._since = now

    def wrap(self, owner: Any, method: str, name: str) -> Callable[[], None]:
        """Count `owner.method` as that part; returns what undoes it."""
        original = getattr(owner, method)

        def timed(*arguments: Any, **options: Any) -> Any:
            with self.part(name):
                return original(*arguments, **options)

        setattr(owner, method, timed)
        return lambda: setattr(owner, method, original)


def watched(optimizer: FIDE, watch: Stopwatch) -> list[Callable[[], None]]:
    """Have the parts of an optimizer timed; returns what ends that."""
    undo = [
        watch.wrap(CMAES, "sample", "search"),
        watch.wrap(CMAES, "tell", "search"),
        watch.wrap(optimizer.evaluator, "as_batch", "copy"),
        watch.wrap(optimizer.state, "record", "copy"),
        watch.wrap(optimizer.encoder, "compute", "encode"),
        watch.wrap(optimizer.evaluator.loss, "compute", "loss"),
    ]
    if optimizer.state.proposer is not None:
        undo += [
            watch.wrap(optimizer.state.proposer, "update", "train"),
            watch.wrap(optimizer.state.proposer, "propose", "sample"),
        ]
    return undo


def parts(task_name: str, preset: str, size: int, renders: int, options: dict[str, Any]) -> Any:
    """Milliseconds an evaluation, by part, of a run by hand."""
    task = fide_tasks.make(task_name, size=size, seed=0)
    optimizer = FIDE(task.dim, task.target, preset=preset, seed=0, device="cpu", **options)
    watch = Stopwatch()
    undo = watched(optimizer, watch)
    try:
        while optimizer.evaluations < renders:
            with watch.part("rest"):
                X = optimizer.ask()
            with watch.part("render"):
                images = task.render(X)
            with watch.part("rest"):
                optimizer.tell(X, images)
    finally:
        for step in undo:
            step()
    return {part: 1e3 * s / optimizer.evaluations for part, s in watch.seconds.items()}


def peak(dtype: torch.dtype, side: int = 1024, repeats: int = 8) -> float:
    """GFLOP/s of the largest products, one thread."""
    a, b = (torch.randn(side, side).to(dtype) for _ in range(2))
    return 2e-9 * side**3 / fastest(lambda: torch.mm(a, b), repeats)


def fastest(work: Callable[[], object], repeats: int) -> float:
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best


def training(T: int, C: int, **options: Any) -> dict[str, float]:
    """An epoch of training on `EXAMPLES` candidates, and proposing half as many."""
    x, std, tokens, proposer = a_proposer(T, C, **options)

    def epoch() -> object:
        return proposer.update(x, tokens, None, std)

    epoch()
    with counted() as counter:
        epoch()
    seconds = fastest(epoch, 3)
    half = EXAMPLES // 2
    proposing = fastest(lambda: proposer.propose(x[:half], tokens[0], x[0], std), 3)
    return {
        "MFLOP an example": 1e-6 * counter.get_total_flops() / EXAMPLES,
        "ms an example": 1e3 * seconds / EXAMPLES,
        "GFLOP/s": 1e-9 * counter.get_total_flops() / seconds,
        "ms a proposal": 1e3 * proposing / half,
    }


def counted() -> FlopCounterMode:
    """Counts floating-point operations, also those of attention, which torch does on a GPU only."""

    def forward(query: Shape, key: Shape, *_: Any, **__: Any) -> int:
        return 4 * prod(query) * key[2]  # two products, of an addition and a multiplication each

    def backward(_: Shape, query: Shape, key: Shape, *__: Any, **___: Any) -> int:
        return 10 * prod(query) * key[2]  # five products; the scores are computed again

    attention = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu
    gradient = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu_backward
    return FlopCounterMode(display=False, custom_mapping={attention: forward, gradient: backward})


def a_proposer(T: int, C: int, **options: Any) -> tuple[Any, Any, torch.Tensor, DiffusionProposer]:
    """`EXAMPLES` candidates x, their std, tokens (n, T, C) of images, and what learns from them."""
    rng = np.random.default_rng(0)
    x, std = rng.random((EXAMPLES, DIM)), np.full(DIM, 1 / 6)
    tokens = torch.rand(EXAMPLES, T, C, generator=torch.Generator().manual_seed(0))
    return x, std, tokens, DiffusionProposer(DIM, epochs=1, **options)


def kernels(T: int, C: int, **options: Any) -> dict[str, float]:
    """Share of each kind of operator in the CPU time of an epoch; of attention, in FLOP."""
    epoch = epoch_of(T, C, **options)
    epoch()
    with counted() as counter:
        epoch()
    flop = {str(name): n for name, n in counter.get_flop_counts()["Global"].items()}
    attention = sum(n for name, n in flop.items() if "attention" in name) / sum(flop.values())
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profiler:
        epoch()
    shares: dict[str, float] = dict.fromkeys([*KINDS, "others"], 0.0)
    for event in profiler.key_averages():
        kind = next((k for k, names in KINDS.items() if any(n in event.key for n in names)), None)
        shares[kind or "others"] += event.self_cpu_time_total
    found = {kind: value / sum(shares.values()) for kind, value in shares.items()}
    return {**found, "FLOP of attention": attention}


def epoch_of(T: int, C: int, compiled: bool = False, **options: Any) -> Callable[[], object]:
    """Training, by the published objective."""
    x, std, tokens, proposer = a_proposer(T, C, **options)
    if compiled:
        network, _ = proposer._parts(T, C)
        network.compile(dynamic=False)
    return lambda: proposer.update(x, tokens, None, std)


def ways() -> Iterator[tuple[str, dict[str, float]]]:
    """Wall time of the published training on images of 112 pixels, done in different ways."""
    for threads in (1, 2):
        torch.set_num_threads(threads)
        for batch in (50, 250, 500):
            epoch = epoch_of(49, 768, batch_size=batch)
            yield f"{threads} threads, batches of {batch}", walls(epoch)
        torch._dynamo.reset()
        epoch = epoch_of(49, 768, compiled=True)
        yield f"{threads} threads, batches of 50, compiled", walls(epoch)


def walls(epoch: Callable[[], object]) -> dict[str, float]:
    """Seconds of the first epoch, with all that is made then, and of the fastest of later ones."""
    seconds = []
    for _ in range(4):
        start = time.perf_counter()
        epoch()
        seconds.append(time.perf_counter() - start)
    return {"first, s": seconds[0], "later, s": min(seconds[1:])}


def table(rows: Sequence[Row]) -> str:
    """All tables, in Markdown; of the same cell the last."""
    last: dict[str, Cells] = {}
    for row in rows:
        last.setdefault(row["kind"], {})[row["cell"]] = row
    makers = {"parts": of_parts, "training": of_training, "kernels": of_kernels, "ways": of_ways}
    return "\n\n".join(as_table(*makers[kind](cells)) for kind, cells in last.items())


Cells = dict[str, Row]
Columns = tuple[Sequence[str], list[list[str]]]  # names, and rows with the name of the cell first


def as_table(names: Sequence[str], rows: list[list[str]]) -> str:
    head = f"| | {' | '.join(names)} |\n|{'---|' * (len(names) + 1)}"
    return "\n".join([head, *(f"| {' | '.join(row)} |" for row in rows)])


def of_parts(cells: Cells) -> Columns:
    return (*PARTS, "all but rendering"), [
        [name, *(f"{row['ms'][part]:.3f}" for part in PARTS), f"{overhead(row['ms']):.3f}"]
        for name, row in cells.items()
    ]


def of_training(cells: Cells) -> Columns:
    names = ("MFLOP an example", "ms an example", "GFLOP/s", "ms a proposal")
    rows = []
    for name, row in cells.items():
        share = row["found"]["GFLOP/s"] / row["peak"]["float32"]
        rows.append([name, *(f"{row['found'][n]:.2f}" for n in names), f"{100 * share:.0f} %"])
    return (*names, "of the peak"), rows


def of_kernels(cells: Cells) -> Columns:
    names = (*KINDS, "others", "FLOP of attention")
    return names, [
        [name, *(f"{100 * row['found'][n]:.0f} %" for n in names)] for name, row in cells.items()
    ]


def of_ways(cells: Cells) -> Columns:
    names = ("first, s", "later, s")
    return names, [
        [name, *(f"{row['found'][n]:.2f}" for n in names)] for name, row in cells.items()
    ]


def overhead(ms: dict[str, float]) -> float:
    return sum(ms.values()) - ms["render"]


def run_parts(arguments: argparse.Namespace) -> None:
    for task in arguments.tasks:
        for preset in arguments.presets:
            for size in arguments.sizes:
                options = (
                    {"epochs": arguments.epochs, "overlap": False} if preset == "paper" else {}
                )
                renders = arguments.renders * (2 if preset == "paper" else 1)
                ms = parts(task, preset, size, renders, options)
                said = f", {arguments.epochs} epochs" if preset == "paper" else ""
                cell = f"{task}, {preset}{said}, {size} px"
                print(f"{cell:42} {overhead(ms):.3f} ms", flush=True)
                append(arguments.out, {"kind": "parts", "cell": cell, "ms": ms})


def run_training(arguments: argparse.Namespace) -> None:
    peaks = {"float32": peak(torch.float32), "bfloat16": peak(torch.bfloat16)}
    print("peak of one thread, GFLOP/s:", peaks)
    for name, settings in TRAINING.items():
        found = training(**settings)
        print(f"{name:32} {found}", flush=True)
        append(arguments.out, {"kind": "training", "cell": name, "found": found, "peak": peaks})


def main() -> None:
    """Measure, or print the tables."""
    arguments = parse_arguments()
    torch.set_num_threads(1)
    if arguments.what == "table":
        print(table(read(arguments.out)))
    elif arguments.what == "parts":
        run_parts(arguments)
    elif arguments.what == "training":
        run_training(arguments)
    elif arguments.what == "kernels":
        for name, settings in TRAINING.items():
            shares = kernels(**settings)
            print(name, {kind: round(share, 3) for kind, share in shares.items()}, flush=True)
            append(arguments.out, {"kind": "kernels", "cell": name, "found": shares})
    else:
        for name, found in ways():
            print(name, found, flush=True)
            append(arguments.out, {"kind": "ways", "cell": name, "found": found})


def parse_arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("what", choices=("parts", "training", "kernels", "ways", "table"))
    parser.add_argument("tasks", nargs="*", default=["voronoi"])
    parser.add_argument("--presets", nargs="+", default=["fast", "balanced", "accurate", "paper"])
    parser.add_argument("--sizes", nargs="+", type=int, default=[112, 224])
    parser.add_argument("--epochs", type=int, default=4, help="epochs of the preset paper (4)")
    parser.add_argument("--renders", type=int, default=1000, help="renders; paper: twice as many")
    parser.add_argument("--out", type=Path, default=RESULTS)
    return parser.parse_args()


if __name__ == "__main__":
    main()
