"""Which encoder, which loss: the tables of docs/encoders.md.

    python benchmarks/encoders.py encoders voronoi spline robot
    python benchmarks/encoders.py losses voronoi spline robot
    python benchmarks/encoders.py table                     # of what was run
    python benchmarks/encoders.py noise                     # how much of a distance is noise
    python benchmarks/encoders.py times                     # of an image, each encoder and loss
    python benchmarks/encoders.py tokens                    # what leaving out tokens saves

Every run (task, target, arm, seed) is one line of benchmarks/results/encoders.jsonl, appended when
it is done; a second call does what is missing.  All arms see the same targets, with the same seeds:
a seed chooses the target, too.  What a run found is judged by every loss, on the task's reference
image.  Time is that of the processor, one thread, all but rendering.

What has no weights on this machine is left out, and said.  The control is the small DINOv3 with
random weights; its files are made in runs/, by transformers.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from numpy.typing import NDArray
from quality import Cell, machine, read, run_missing

import fide_tasks
from fide_plugins import FIDE, encoders, harness, losses
from fide_plugins.errors import DependencyError, WeightsError
from fide_plugins.proposers.linear import LinearProposer

RESULTS = Path(__file__).parent / "results" / "encoders.jsonl"
CONTROL = Path("runs/dinov3-small-random")
STEP = 50  # renders between two points of a curve


class Scene(NamedTuple):
    """How a task is run."""

    budget: int
    seeds: int
    options: dict[str, Any]


SCENES = {
    "voronoi": Scene(2000, 10, {}),
    "spline": Scene(2000, 10, {}),
    "robot": Scene(1000, 10, {}),
    "san_miguel": Scene(800, 2, {"spp": 8}),
    "beads": Scene(800, 2, {"spp": 16}),
}
ENCODERS = {
    "dense": "dense",
    "patch": "patch",
    "random ViT-S/16": f"dinov3:{CONTROL}",
    "dinov3": "dinov3",
    "vgg19": "vgg19",
}
LOSSES = ("mse", "loi", "perceptual", "lpips")


# -- runs ------------------------------------------------------------------------------------------


class Clocked:
    """A task that counts the processor's time for its renders."""

    def __init__(self, task: fide_tasks.Task) -> None:
        self.task, self.seconds = task, 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.task, name)

    def render(self, X: NDArray[np.float64], seed: Any = None) -> Any:
        """Images of candidates."""
        start = time.process_time()
        images = self.task.render(X, seed=seed)
        self.seconds += time.process_time() - start
        return images


def run_cell(cell: Cell, loss: str, options: dict[str, Any]) -> Cell:
    """One run: its curve, its time, and the judgment of what it found."""
    scene = SCENES[cell["task"]]
    task = Clocked(fide_tasks.make(cell["task"], cell["size"], cell["target"], **scene.options))
    start = time.process_time()
    result = harness.run(task, "fide", loss, cell["budget"], cell["seed"], options=options)
    own = time.process_time() - start - task.seconds
    best = np.minimum.accumulate(result.losses)
    image = task.reference(result.x_best) if result.x_best is not None else task.target
    return {
        **cell,
        "best": [float(f"{value:.4g}") for value in best[STEP - 1 :: STEP]],
        "judged": {
            name: float(losses.make(name, task.target)(image[None])[0])
            for name in LOSSES
            if problem("loss", name) is None
        },
        "ms": round(own / cell["budget"] * 1e3, 3),
        "encoder": encoders.make(options.get("encoder", "dense")).version,
        "date": time.strftime("%Y-%m-%d"),
        "machine": machine(),
    }


def cells(arguments: argparse.Namespace, arms: list[str]) -> Iterator[Cell]:
    """All cells, seeds outermost, so that a table can be made before the last is done."""
    scenes = {name: SCENES[name] for name in arguments.tasks or list(SCENES)[:3]}
    seeds = {task: arguments.seeds or scene.seeds for task, scene in scenes.items()}
    for seed in range(max(seeds.values())):
        for task, scene in scenes.items():
            if seed >= seeds[task]:
                continue
            for arm in arms:
                yield {
                    "task": task,
                    "target": seed,
                    "arm": arm,
                    "seed": seed,
                    "size": arguments.size,
                    "budget": arguments.budget or scene.budget,
                }


def run_encoders(arguments: argparse.Namespace) -> None:
    """Runs of the mean squared error that differ in the encoder."""
    if "random ViT-S/16" in arguments.arms:
        make_control()
    arms = [arm for arm in arguments.arms if usable("encoder", ENCODERS[arm])]
    table = {f"encoder {arm}": ("mse", {"encoder": ENCODERS[arm]}) for arm in arms}
    run_missing(cells(arguments, list(table)), table, arguments.out, "0/1", run_cell)


def run_losses(arguments: argparse.Namespace) -> None:
    """Runs that differ in the loss; those of `mse` are those of the encoder `dense`."""
    names = [name for name in LOSSES if name != "mse" and usable("loss", name)]
    table: dict[str, tuple[str, dict[str, Any]]] = {f"loss {name}": (name, {}) for name in names}
    run_missing(cells(arguments, list(table)), table, arguments.out, "0/1", run_cell)


def problem(kind: str, name: str) -> str | None:
    """What keeps an encoder or a loss from being used here."""
    try:
        encoders.make(name) if kind == "encoder" else losses.make(name, np.zeros((64, 64, 3)))
    except (WeightsError, DependencyError) as error:
        return str(error)
    return None


def usable(kind: str, name: str) -> bool:
    """Whether it can be used here; says on standard error why it cannot."""
    why = problem(kind, name)
    if why is not None:
        print(f"left out: {name}: {why}", file=sys.stderr)
    return why is None


def make_control() -> None:
    """Files of a small DINOv3 with random weights, the same everywhere."""
    if (CONTROL / "model.safetensors").exists():
        return
    from transformers import DINOv3ViTConfig, DINOv3ViTModel

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        DINOv3ViTModel(DINOv3ViTConfig(num_register_tokens=4)).save_pretrained(CONTROL)


# -- tables ----------------------------------------------------------------------------------------


def tables(rows: list[Cell]) -> str:
    """All tables, in Markdown: medians over the seeds that all arms of a table share."""
    every = of(rows, "encoder")
    handmade = [row for row in every if row["arm"][8:] in ("dense", "patch")]
    with_networks = {(row["task"], row["size"]) for row in every if row not in handmade}
    networks = [row for row in every if (row["task"], row["size"]) in with_networks]
    blocks = [
        encoder_table(handmade, (500, 1000, 2000)),
        encoder_table(up_to_the_shortest(networks), (100, 200, 300, 500, 1000)),
        loss_table(of_losses(rows)),
    ]
    return "\n\n".join("\n".join(block) for block in blocks)


def of(rows: list[Cell], kind: str) -> list[Cell]:
    return [row for row in rows if row["arm"].startswith(f"{kind} ")]


def up_to_the_shortest(rows: list[Cell]) -> list[Cell]:
    """Rows with curves of the same length: no run knows its budget, so all are alike till then."""
    length = min((len(row["best"]) for row in rows), default=0)
    return [{**row, "best": row["best"][:length]} for row in rows]


def of_losses(rows: list[Cell]) -> list[Cell]:
    """Rows that differ in the loss; the encoder `dense` has minimized the mean squared error."""
    others = of(rows, "loss")
    where = {(row["task"], row["size"]) for row in others}
    mse = [row for row in rows if row["arm"] == "encoder dense"]
    return [{**r, "arm": "loss mse"} for r in mse if (r["task"], r["size"]) in where] + others


def groups(rows: list[Cell]) -> Iterator[tuple[str, str, list[Cell]]]:
    """Task, arm and rows of the runs, of those seeds that every arm of the task and size has."""
    for task, size in dict.fromkeys((row["task"], row["size"]) for row in rows):
        mine = [row for row in rows if (row["task"], row["size"]) == (task, size)]
        by_arm: dict[str, dict[int, Cell]] = {}
        for row in mine:
            by_arm.setdefault(row["arm"], {})[row["seed"]] = row
        shared = set.intersection(*(set(by_seed) for by_seed in by_arm.values()))
        for arm, by_seed in by_arm.items():
            if len(by_arm) > 1 and shared:
                yield f"{task}, {size} px", arm, [by_seed[seed] for seed in sorted(shared)]


def encoder_table(rows: list[Cell], marks: Sequence[int]) -> list[str]:
    """Losses after some renders, milliseconds a render, and the comparison with `patch`."""
    marks = [m for m in marks if any(len(row["best"]) * STEP >= m for row in rows)]
    head = ["task", "encoder", "runs", *(f"{m:,}" for m in marks), "better than `patch`", "ms"]
    lines = [f"| {' | '.join([*head, 'time to the loss of `patch`'])} |"]
    lines.append("|---|---|" + "---:|" * (len(head) - 1))
    table = list(groups(rows))
    patch = {task: group for task, arm, group in table if arm[8:] == "patch"}
    for task, arm, group in table:
        losses_then = [median_at(group, renders) for renders in marks]
        cost = f"{statistics.median(row['ms'] for row in group):.2f}"
        others = patch[task]
        wins = sum(r["best"][-1] < o["best"][-1] for r, o in zip(group, others, strict=True))
        better = "" if arm[8:] == "patch" else f"{wins} of {len(group)}"
        share = statistics.median(map(share_of_time, group, others))
        when = f"{share:.2f}" if share < float("inf") else "not reached"
        cells = [task, arm[8:], len(group), *losses_then, better, cost, when]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return lines


def median_at(rows: list[Cell], renders: int) -> str:
    """Median best loss after so many renders."""
    if any(len(row["best"]) * STEP < renders for row in rows):
        return ""
    return f"{statistics.median(row['best'][renders // STEP - 1] for row in rows):.5f}"


def share_of_time(row: Cell, other: Cell) -> float:
    """The time a run took to the other's final loss, over the time the other took; inf if never."""
    final = other["best"][-1]
    mine, others = (time_to(final, each) for each in (row, other))
    return mine / others


def time_to(loss: float, row: Cell) -> float:
    """Milliseconds of the optimizer until a run had that loss; inf if it never had."""
    reached = [i for i, value in enumerate(row["best"], 1) if value <= loss]
    return float(reached[0] * STEP * row["ms"]) if reached else float("inf")


def loss_table(rows: list[Cell]) -> list[str]:
    names = [name for name in LOSSES if any(name in row["judged"] for row in rows)]
    lines = [f"| task | minimized | runs | {' | '.join(names)} | ms |"]
    lines.append("|---|---|" + "---:|" * (len(names) + 2))
    for task, arm, group in groups(rows):
        judged = [
            f"{statistics.median(row['judged'][name] for row in group):.4g}" for name in names
        ]
        cost = statistics.median(row["ms"] for row in group)
        lines.append(f"| {task} | {arm[5:]} | {len(group)} | {' | '.join(judged)} | {cost:.2f} |")
    return lines


# -- noise, times, tokens --------------------------------------------------------------------------


def print_noise(arguments: argparse.Namespace) -> None:
    """Median distance of two renders of one candidate over that of two candidates."""
    one, two = noisy_pairs(arguments.size)
    print("| | distance of noise / of candidates |\n|---|---:|")
    for name in LOSSES:
        if problem("loss", name) is None:
            distances = np.array([losses.make(name, target)(two) for target in one])
            print(f"| loss `{name}` | {noise_share(distances):.3f} |")
    for name in ENCODERS.values():
        if problem("encoder", name) is None:
            make = encoders.make(name)
            print(f"| encoder `{name}`, squared | {noise_share(squares(make, one, two)):.3f} |")


def noisy_pairs(size: int) -> tuple[Any, Any]:
    """Two renders each of 24 candidates of Beads, as at the start of a search."""
    task = fide_tasks.make("beads", size, 0, spp=16)
    X = np.random.default_rng(0).normal(0.5, 1 / 6, (24, task.dim)).clip(0, 1)
    one, two = (task.render(X, seed=[100 * k + i for i in range(len(X))]) for k in (1, 2))
    return one, two


def squares(encoder: Any, one: Any, two: Any) -> NDArray[np.float64]:
    """Squared distances (n, n) of the features of images from those of others."""
    e, f = (encoder(images).flatten(1).double() for images in (one, two))
    distances: NDArray[np.float64] = torch.cdist(e, f).numpy() ** 2
    return distances


def noise_share(distances: NDArray[np.float64]) -> float:
    """Of distances (n, n): median of the diagonal over the median of the others."""
    others = distances[~np.eye(len(distances), dtype=bool)]
    return float(np.median(np.diag(distances)) / np.median(others))


def print_times(arguments: argparse.Namespace) -> None:
    """Milliseconds of the processor for an image, in a batch."""
    make_control()
    rng = np.random.default_rng(0)
    print("| | 112x112 | 224x224 |\n|---|---:|---:|")
    for kind, names in (("encoder", ENCODERS.values()), ("loss", LOSSES)):
        for name in names:
            if not usable(kind, name):
                continue
            row = []
            for side in (112, 224):
                n = 8 if name.startswith(("dinov3", "vgg")) else 100
                images = rng.random((n, side, side, 3), dtype=np.float32)
                made = encoders.make(name) if kind == "encoder" else losses.make(name, images[0])
                row.append(f"{1e3 * fastest(made, images) / n:.2f}")
            print(f"| {kind} `{name}` | {' | '.join(row)} |", flush=True)
    row = [
        f"{1e3 * fastest(checksums, np.zeros((100, n, n, 3), np.float32)) / 100:.2f}"
        for n in (112, 224)
    ]
    print(f"| SHA-256, by which images are kept | {' | '.join(row)} |", flush=True)
    for encoder in ("dense", "patch"):
        row = [f"{optimizing(encoder, side):.2f}" for side in (112, 224)]
        print(f"| FIDE with `{encoder}`, all but rendering | {' | '.join(row)} |", flush=True)
    print(f"\nencoder `dinov3` over the bare network: {ratio_to_bare_network():.2f}")


def checksums(images: NDArray[np.float32]) -> None:
    for image in images:
        hashlib.sha256(image.data).digest()


def fastest(made: Any, images: NDArray[np.float32]) -> float:
    """Seconds of the processor, the least of three goes; images no cache has seen."""
    goes = []
    for go in range(3):
        fresh = images * np.float32(1 - go / 1000)
        start = time.process_time()
        made(fresh)
        goes.append(time.process_time() - start)
    return min(goes)


def optimizing(encoder: str, side: int) -> float:
    """Milliseconds of FIDE for one of 300 candidates of Voronoi."""
    cell = {"task": "voronoi", "target": 0, "seed": 0, "size": side, "budget": 300}
    return float(run_cell(cell, "mse", {"encoder": encoder})["ms"])


def ratio_to_bare_network() -> float:
    """Time of the encoder for a batch of 16 at 224 x 224 over that of transformers alone."""
    from transformers import AutoModel

    network = AutoModel.from_pretrained(CONTROL).eval()
    encoder = encoders.make(f"dinov3:{CONTROL}")
    images = np.random.default_rng(0).random((16, 224, 224, 3), dtype=np.float32)

    @torch.inference_mode()
    def bare(images: NDArray[np.float32]) -> None:
        network(torch.from_numpy(images).permute(0, 3, 1, 2).contiguous())

    return fastest(encoder, images) / fastest(bare, images)


def print_tokens(arguments: argparse.Namespace) -> None:
    """What leaving out tokens saves the proposer."""
    print("| task | size | encoder | tokens in use | ms, all tokens | ms | MB, all tokens | MB |")
    print("|---|---:|---|---:|---:|---:|---:|---:|")
    for name in arguments.tasks or ("robot", "spline", "voronoi"):
        for size, encoder in ((112, "dense"), (112, "patch"), (224, "patch")):
            every, some = (proposing(name, size, encoder, select) for select in (False, True))
            print(
                f"| {name} | {size} | {encoder} | {100 * some[1]:.0f} % | {every[0]:.2f} | "
                f"{some[0]:.2f} | {every[2]:.1f} | {some[2]:.1f} |",
                flush=True,
            )


def proposing(name: str, size: int, encoder: str, select: bool) -> tuple[float, float, float]:
    """Milliseconds a candidate, mean share of tokens in use, most megabytes of features."""
    task = fide_tasks.make(name, size, 0)
    opt = FIDE(task.dim, task.target, seed=0, encoder=encoder, select_tokens=select)
    proposer = opt._proposer
    assert isinstance(proposer, LinearProposer)
    seconds, shares, megabytes = 0.0, [], 0.0
    update, propose = proposer.update, proposer.propose

    def clocked(step: Any) -> Any:
        def go(*arguments: Any) -> Any:
            nonlocal seconds
            start = time.process_time()
            result = step(*arguments)
            seconds += time.process_time() - start
            return result

        return go

    proposer.update, proposer.propose = clocked(update), clocked(propose)  # type: ignore[method-assign]
    while opt.evaluations < 600:
        X = opt.ask()
        opt.tell(X, task.render(X))
        views = proposer._views
        shares.append(float(views[-1].used.mean()) if views[-1].used.size else 1.0)
        megabytes = max(megabytes, sum(view.features.nbytes for view in views) / 1e6)
    return 1e3 * seconds / opt.evaluations, float(np.mean(shares)), megabytes


def main() -> None:
    """Do what is asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("what", choices=("encoders", "losses", "table", "noise", "times", "tokens"))
    add("tasks", nargs="*", metavar="TASK", help="voronoi, spline, robot; san_miguel and beads")
    add("--arms", nargs="+", default=list(ENCODERS), choices=list(ENCODERS), metavar="ARM")
    add("--seeds", type=int)
    add("--budget", type=int)
    add("--size", type=int, default=112, metavar="PX")
    add("--out", type=Path, default=RESULTS, metavar="FILE")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.what == "table":
        print(tables(read(arguments.out)))
        return
    steps = {"encoders": run_encoders, "losses": run_losses, "noise": print_noise}
    steps |= {"times": print_times, "tokens": print_tokens}
    steps[arguments.what](arguments)


if __name__ == "__main__":
    main()
