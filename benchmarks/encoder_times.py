"""Times of encoders and losses: tables of lab/reports/encoders_times.md.

    python benchmarks/encoder_times.py images               # per image, each encoder and loss
    python benchmarks/encoder_times.py split voronoi spline # where FIDE's time goes
    python benchmarks/encoder_times.py tokens robot         # what leaving out tokens saves
    python benchmarks/encoder_times.py batches              # batch size of a network

All times are milliseconds of CPU time, one thread, without rendering.  `split`, `images` and
`batches` take the minimum of three repeats.  In `split` the encoders take turns, and in `batches`
the batch sizes do, so that other programs slow down all of them alike.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import sys
import time
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from encoder_tables import LOSSES
from encoders import CONTROL, ENCODERS, make_control, usable
from numpy.typing import NDArray

import fide_tasks
from fide_plugins import FIDE, encoders, losses
from fide_plugins.proposers.linear import LinearProposer

SIDES = (112, 224)
GOES = 3
BATCHES = (1, 2, 4, 8)
RENDERS = 600
Images = NDArray[np.float32]


# -- of an image -----------------------------------------------------------------------------------


def print_images(arguments: argparse.Namespace) -> None:
    """Milliseconds for an image, in a batch; of `dense` with and without noise."""
    make_control()
    print("| | 112x112 | 224x224 |\n|---|---:|---:|")
    for kind, names in (("encoder", ENCODERS.values()), ("loss", LOSSES)):
        for name in names:
            if usable(kind, name):
                print_row(f"{kind} `{name}`", [cost_of(kind, name, side) for side in SIDES])
    dense = encoders.make("dense")
    print_row("encoder `dense`, noise", [fastest(dense, noisy(100, side)) for side in SIDES])
    print_row(
        "SHA-256, by which images are kept",
        [fastest(checksums, pictures(100, side)) for side in SIDES],
    )
    print(f"\nencoder `dinov3` over the bare network: {ratio_to_bare_network():.2f}")


def print_row(what: str, milliseconds: list[float]) -> None:
    print(f"| {what} | {' | '.join(f'{ms:.2f}' for ms in milliseconds)} |", flush=True)


def cost_of(kind: str, name: str, side: int) -> float:
    images = pictures(8 if name.startswith(("dinov3", "vgg")) else 100, side)
    made = encoders.make(name) if kind == "encoder" else losses.make(name, images[0])
    return fastest(made, images)


def pictures(n: int, side: int) -> Images:
    """Renders of Voronoi, which have no noise."""
    task = fide_tasks.make("voronoi", side, 0)
    images: Images = task.render(np.random.default_rng(0).random((n, task.dim)))
    return images


def noisy(n: int, side: int) -> Images:
    return np.random.default_rng(0).random((n, side, side, 3), dtype=np.float32)


def checksums(images: Images) -> None:
    for image in images:
        hashlib.sha256(image.data).digest()


def fastest(made: Any, images: Images) -> float:
    """Milliseconds of CPU time for an image, the least of the goes; no cache has seen them."""
    goes = []
    for go in range(GOES):
        fresh = images * np.float32(1 - go / 1000)
        start = time.process_time()
        made(fresh)
        goes.append(time.process_time() - start)
    return 1e3 * min(goes) / len(images)


def ratio_to_bare_network() -> float:
    """Time of the encoder for a batch of 16 at 224 x 224 over that of transformers alone."""
    from transformers import AutoModel

    network = AutoModel.from_pretrained(CONTROL).eval()

    @torch.inference_mode()
    def bare(images: Images) -> None:
        network(torch.from_numpy(images).permute(0, 3, 1, 2).contiguous())

    images = noisy(16, 224)
    return fastest(encoders.make(f"dinov3:{CONTROL}"), images) / fastest(bare, images)


def print_batches(arguments: argparse.Namespace) -> None:
    """Milliseconds for an image, by how many of them a network sees together."""
    make_control()
    print(f"| network | side | {' | '.join(map(str, BATCHES))} |\n|---|" + "---:|" * 5)
    for configuration in ("random ViT-S/16", "vgg19"):
        if usable("encoder", ENCODERS[configuration]):
            network: Any = encoders.make(ENCODERS[configuration])
            for side in (112, 64):
                print_row(f"{configuration} | {side}", in_batches(network._features, side))


@torch.inference_mode()
def in_batches(network: Any, side: int) -> list[float]:
    """Milliseconds for an image of 8, which are seen in batches of each size."""
    images = torch.rand(max(BATCHES), 3, side, side, generator=torch.Generator().manual_seed(0))
    least = dict.fromkeys(BATCHES, float("inf"))
    for _ in range(GOES):
        for size in BATCHES:
            start = time.process_time()
            for batch in torch.split(images, size):
                network(batch)
            least[size] = min(least[size], time.process_time() - start)
    return [1e3 * seconds / len(images) for seconds in least.values()]


# -- of FIDE ---------------------------------------------------------------------------------------


class Clocks:
    """Seconds of CPU time in some methods of an optimizer, and in all of its own."""

    def __init__(self, opt: FIDE) -> None:
        self.seconds = {"encoder": 0.0, "proposer": 0.0, "all": 0.0}
        self.ask, self.tell = self.clocked("all", opt.ask), self.clocked("all", opt.tell)
        setattr(opt.encoder, "compute", self.clocked("encoder", opt.encoder.compute))  # noqa: B010
        for name in ("update", "propose"):
            step = self.clocked("proposer", getattr(opt.state.proposer, name))
            setattr(opt.state.proposer, name, step)

    def clocked(self, part: str, step: Any) -> Any:
        def go(*arguments: Any) -> Any:
            start = time.process_time()
            try:
                return step(*arguments)
            finally:
                self.seconds[part] += time.process_time() - start

        return go

    def milliseconds(self, renders: int) -> dict[str, float]:
        """For a candidate, with what is in no part as `rest`."""
        ms = {part: 1e3 * seconds / renders for part, seconds in self.seconds.items()}
        return {**ms, "rest": ms["all"] - ms["encoder"] - ms["proposer"]}


def print_split(arguments: argparse.Namespace) -> None:
    """Milliseconds for a candidate: encoding, proposing, the rest; and over those of `patch`."""
    names = ("dense", "patch")
    print("| task | size | encoder | all | encoding | proposer | rest | all / `patch` |", end="")
    print(" encoding and proposer / `patch` |\n|---|---:|---|" + "---:|" * 6)
    for task in arguments.tasks or ("voronoi", "spline"):
        for side in SIDES:
            goes = [[split(task, side, name) for name in names] for _ in range(GOES)]
            best = [min((go[i] for go in goes), key=lambda ms: ms["all"]) for i in range(2)]
            for name, ms in zip(names, best, strict=True):
                parts = " | ".join(f"{ms[k]:.2f}" for k in ("all", "encoder", "proposer", "rest"))
                images = [each["encoder"] + each["proposer"] for each in (ms, best[1])]
                shares = f"{ms['all'] / best[1]['all']:.2f} | {images[0] / images[1]:.2f}"
                print(f"| {task} | {side} | `{name}` | {parts} | {shares} |", flush=True)


def split(name: str, side: int, encoder: str) -> dict[str, float]:
    task = fide_tasks.make(name, side, 0)
    opt = FIDE(task.dim, task.target, seed=0, encoder=encoder)
    clocks = Clocks(opt)
    while opt.evaluations < RENDERS:
        X = clocks.ask()
        clocks.tell(X, task.render(X))
    return clocks.milliseconds(opt.evaluations)


def print_tokens(arguments: argparse.Namespace) -> None:
    """What leaving out tokens saves the proposer."""
    print("| task | size | encoder | tokens in use | ms, all tokens | ms | MB, all tokens | MB |")
    print("|---|---:|---|---:|---:|---:|---:|---:|")
    for name in arguments.tasks or ("robot", "spline", "voronoi"):
        for side, encoder in ((112, "dense"), (112, "patch"), (224, "patch")):
            every, some = (proposing(name, side, encoder, select) for select in (False, True))
            print(
                f"| {name} | {side} | {encoder} | {100 * some[1]:.0f} % | {every[0]:.2f} | "
                f"{some[0]:.2f} | {every[2]:.1f} | {some[2]:.1f} |",
                flush=True,
            )


def proposing(name: str, side: int, encoder: str, select: bool) -> tuple[float, float, float]:
    """Milliseconds a candidate, mean share of tokens in use, most megabytes of features."""
    task = fide_tasks.make(name, side, 0)
    opt = FIDE(task.dim, task.target, seed=0, encoder=encoder, select_tokens=select)
    proposer, clocks = opt.state.proposer, Clocks(opt)
    if not isinstance(proposer, LinearProposer):
        raise TypeError(
            f"the buffers of a LinearProposer are counted, got {type(proposer).__name__}"
        )
    shares, megabytes = [], 0.0
    while opt.evaluations < RENDERS:
        X = opt.ask()
        opt.tell(X, task.render(X))
        buffers = proposer._buffers
        shares.append(float(buffers[-1].used.mean()) if buffers[-1].used.size else 1.0)
        megabytes = max(megabytes, sum(buffer.features.nbytes for buffer in buffers) / 1e6)
    return clocks.milliseconds(opt.evaluations)["proposer"], float(np.mean(shares)), megabytes


def main() -> None:
    """Print what is asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    tables = {"images": print_images, "split": print_split, "tokens": print_tokens}
    tables["batches"] = print_batches
    parser.add_argument("what", choices=list(tables))
    parser.add_argument("tasks", nargs="*", metavar="TASK")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.tasks and arguments.what in ("images", "batches"):
        print(f"`{arguments.what}` needs no task", file=sys.stderr)
    tables[arguments.what](arguments)


if __name__ == "__main__":
    main()
