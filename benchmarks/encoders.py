"""Which encoder, which loss: the tables of docs/measurements/encoders.md.

    python benchmarks/encoders.py encoders voronoi spline robot
    python benchmarks/encoders.py losses voronoi spline robot
    python benchmarks/encoders.py table                     # of the recorded runs
    python benchmarks/encoders.py paired                    # is `dense` better than `patch`?

Every run (task, target, encoder or loss, seed) is one line of benchmarks/results/encoders.jsonl,
appended when it ends.  A second call does the missing runs.  All encoders and losses have the same
targets and seeds: a seed also chooses the target.  Every loss judges each result, on the task's
reference image.  Times are CPU times, one thread, without rendering.

Encoders without weights on this machine are left out, with a message.  The control is the small
DINOv3 with random weights; transformers creates its files in runs/.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from numpy.typing import NDArray
from quality import Cell, machine, read, run_missing
from scipy.stats import wilcoxon

import fide_tasks
from fide_plugins import encoders, losses
from fide_plugins.encoders.pretrained.network import IMAGENET_MEAN, IMAGENET_STD
from fide_plugins.errors import DependencyError, WeightsError
from fide_plugins.experiments import run as harness

RESULTS = Path(__file__).parent / "results" / "encoders.jsonl"
RUNS = Path("runs/encoders")
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
    "san_miguel": Scene(600, 3, {"spp": 8}),
    "beads": Scene(600, 3, {"spp": 16}),
}
ENCODERS = {
    "dense": "dense",
    "patch": "patch",
    "random ViT-S/16": f"dinov3:{CONTROL}",
    "dinov3": "dinov3",
    "vgg19": "vgg19",
}
LOSSES = ("mse", "loi", "perceptual", "lpips")
TRACED = ("san_miguel", "beads")  # noisy: what was seen is the luckiest too, what counts is judged


# -- runs ------------------------------------------------------------------------------------------


class Clocked:
    """A task that counts the CPU time of its renders."""

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
    """One run: its curve, its time unless it was resumed, and the judgment of what it found."""
    scene = SCENES[cell["task"]]
    task = Clocked(fide_tasks.make(cell["task"], cell["size"], cell["target"], **scene.options))
    start = time.process_time()
    result = harness.run(
        task, "fide", loss, cell["budget"], cell["seed"], options=options, **directory(cell)
    )
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
        **({} if cell["task"] in TRACED else {"ms": round(own / cell["budget"] * 1e3, 3)}),
        "encoder": encoders.make(options.get("encoder", "dense")).version,
        "date": time.strftime("%Y-%m-%d"),
        "machine": machine(),
    }


def directory(cell: Cell) -> dict[str, Any]:
    """Where a run that takes minutes is saved, so that it goes on if it is interrupted."""
    if cell["task"] not in TRACED:
        return {}
    name = "-".join(str(cell[key]) for key in ("task", "arm", "target", "seed", "size", "budget"))
    return {"out": RUNS / name.replace(" ", "_").replace("/", "_"), "resume": True}


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
                    **scene.options,
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
    say_colors()
    if (CONTROL / "model.safetensors").exists():
        return
    from transformers import DINOv3ViTConfig, DINOv3ViTModel

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        DINOv3ViTModel(DINOv3ViTConfig(num_register_tokens=4)).save_pretrained(CONTROL)


def say_colors() -> None:
    """Beside the control's files, those colors that DINOv3 expects."""
    said = {"image_mean": IMAGENET_MEAN, "image_std": IMAGENET_STD}
    CONTROL.mkdir(parents=True, exist_ok=True)
    (CONTROL / "preprocessor_config.json").write_text(json.dumps(said))


# -- tables ----------------------------------------------------------------------------------------


def tables(rows: list[Cell]) -> str:
    """All tables, in Markdown: medians over the seeds that all arms of a table share."""
    traced = [row for row in rows if row["task"] in TRACED]
    rows = [row for row in rows if row["task"] not in TRACED]
    every = of(rows, "encoder")
    handmade = [row for row in every if row["arm"][8:] in ("dense", "patch")]
    with_networks = {(row["task"], row["size"]) for row in every if row not in handmade}
    networks = [row for row in every if (row["task"], row["size"]) in with_networks]
    blocks = [
        encoder_table(handmade, (500, 1000, 2000)),
        encoder_table(up_to_the_shortest(networks), (100, 200, 300, 500, 1000)),
        loss_table(of_losses(rows)),
        traced_table(traced, (200, 400, 600)),
        versions([*rows, *traced]),
    ]
    return "\n\n".join("\n".join(block) for block in blocks)


def versions(rows: list[Cell]) -> list[str]:
    """Which versions of encoders made the features of the rows, and of how many: one line."""
    counts = Counter(row["encoder"] for row in rows)
    return [f"Runs: {', '.join(f'{n} with {version}' for version, n in sorted(counts.items()))}."]


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


def traced_table(rows: list[Cell], marks: Sequence[int]) -> list[str]:
    """Lowest loss seen after some renders, and every loss of what was found, on the reference."""
    names = [name for name in LOSSES if any(name in row["judged"] for row in rows)]
    lines = [
        f"| task | minimized | encoder | runs | {' | '.join(f'{m:,}' for m in marks)} | "
        f"{' | '.join(f'judged {name}' for name in names)} |",
        "|---|---|---|" + "---:|" * (1 + len(marks) + len(names)),
    ]
    for task, label, group in groups(rows):
        kind, arm = label.split(" ", 1)
        minimized, encoder = ("mse", arm) if kind == "encoder" else (arm, "dense")
        seen = [median_at(group, mark) for mark in marks]
        judged = [f"{statistics.median(row['judged'][n] for row in group):.4g}" for n in names]
        cells = [task, minimized, encoder, str(len(group)), *seen, *judged]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


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
        compared = compared_to(group, patch[task]) if task in patch else ("", "")
        better = "" if arm[8:] == "patch" else compared[0]
        cells = [task, arm[8:], len(group), *losses_then, better, cost, compared[1]]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return lines


def compared_to(rows: list[Cell], others: list[Cell]) -> tuple[str, str]:
    """In how many runs the end is better than the other's, and the median share of its time."""
    wins = sum(r["best"][-1] < o["best"][-1] for r, o in zip(rows, others, strict=True))
    share = statistics.median(map(share_of_time, rows, others))
    return f"{wins} of {len(rows)}", f"{share:.2f}" if share < float("inf") else "not reached"


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


def paired_table(rows: list[Cell]) -> list[str]:
    """Loss of `dense` over that of `patch` on the same targets: geometric mean, how often, chance.

    The interval is of two standard errors of the mean logarithm; p is that of Wilcoxon's
    signed-rank test, two-sided, that the logarithms differ in neither direction.
    """
    handmade = [row for row in of(rows, "encoder") if row["arm"][8:] in ("dense", "patch")]
    groups_of = {(task, arm[8:]): group for task, arm, group in groups(handmade)}
    lines = ["| task | renders | pairs | `dense` / `patch` | better | p |", "|---|" + "---:|" * 5]
    for task in dict.fromkeys(task for task, _ in groups_of):
        pairs = list(zip(groups_of[task, "dense"], groups_of[task, "patch"], strict=True))
        for mark in (500, 1000, 2000):
            short = any(len(row["best"]) * STEP < mark for pair in pairs for row in pair)
            if len(pairs) < 2 or short:
                continue
            at = mark // STEP - 1
            d = np.array([np.log(own["best"][at] / other["best"][at]) for own, other in pairs])
            middle, error = d.mean(), 2 * d.std(ddof=1) / np.sqrt(len(d))
            low, ratio, high = np.exp([middle - error, middle, middle + error])
            lines.append(
                f"| {task} | {mark:,} | {len(d)} | {ratio:.2f} ({low:.2f} to {high:.2f}) | "
                f"{(d < 0).sum()} of {len(d)} | {wilcoxon(d).pvalue:.2g} |"
            )
    return [*lines, "", *versions(handmade)]


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


def main() -> None:
    """Do what is asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("what", choices=("encoders", "losses", "table", "paired"))
    add("tasks", nargs="*", metavar="TASK", help="voronoi, spline, robot; san_miguel and beads")
    add("--arms", nargs="+", default=list(ENCODERS), choices=list(ENCODERS), metavar="ARM")
    add("--seeds", type=int)
    add("--budget", type=int)
    add("--size", type=int, default=112, metavar="PX")
    add("--out", type=Path, default=RESULTS, metavar="FILE")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.what in ("table", "paired"):
        rows = read(arguments.out)
        print(tables(rows) if arguments.what == "table" else "\n".join(paired_table(rows)))
        return
    {"encoders": run_encoders, "losses": run_losses}[arguments.what](arguments)


if __name__ == "__main__":
    main()
