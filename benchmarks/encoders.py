"""Which encoder, which loss: tables of lab/reports/encoders_quality.md, encoders_other.md.

    python benchmarks/encoders.py encoders voronoi spline robot
    python benchmarks/encoders.py losses voronoi spline robot
    python benchmarks/encoders.py table                     # of the recorded runs
    python benchmarks/encoders.py paired                    # is `dense` better than `patch`?
    python benchmarks/encoders.py paired --pair learned dense --out runs/learned_encoders.jsonl
    python benchmarks/encoders.py encoders robot --configurations dense patch learned \
        --out runs/learned_encoders.jsonl                   # of the model runs/robot.fide

Every run (task, target, encoder or loss, seed) is one line of benchmarks/results/encoders.jsonl,
appended when it ends.  A second call does the missing runs.  All encoders and losses have the same
targets and seeds: a seed also chooses the target.  Every loss judges each result, on the task's
reference image.  Times are CPU times, one thread, without rendering.

Encoders without weights on this machine are left out, with a message.  The control is the small
DINOv3 with random weights; transformers creates its files in runs/.  `learned` is the encoder of
the model runs/TASK.fide, which `fide learn` makes.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from encoder_tables import LOSSES, STEP, TRACED, paired_table, tables
from numpy.typing import NDArray
from quality import run_configurations
from rows import Row, read

import fide_tasks
from fide_lab import run as harness
from fide_plugins import encoders, losses
from fide_plugins.encoders.pretrained.network import IMAGENET_MEAN, IMAGENET_STD
from fide_plugins.errors import DependencyError, WeightsError
from fide_plugins.recording.record import best_so_far

RESULTS = Path(__file__).parent / "results" / "encoders.jsonl"
RUNS = Path("runs/encoders")
CONTROL = Path("runs/dinov3-small-random")


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
    "efficientnet": "efficientnet",
    "vgg19": "vgg19",
    "learned": "learned:runs/{task}.fide",
}


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


def measure(cell: Row, loss: str, options: dict[str, Any]) -> Row:
    """One run: its curve, its time unless it was resumed, and the judgment of what it found."""
    scene = SCENES[cell["task"]]
    options = {key: for_task(value, cell["task"]) for key, value in options.items()}
    task = Clocked(fide_tasks.make(cell["task"], cell["size"], cell["target"], **scene.options))
    start = time.process_time()
    result = harness.run(
        task, "fide", loss, cell["budget"], cell["seed"], options=options, **directory(cell)
    )
    own = time.process_time() - start - task.seconds
    best = best_so_far(result.losses)
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
    }


def for_task(value: Any, task: str) -> Any:
    """An option, with the name of the task in place of {task}."""
    return value.format(task=task) if isinstance(value, str) else value


def directory(cell: Row) -> dict[str, Any]:
    """Where a run that takes minutes is saved, so that it goes on if it is interrupted."""
    if cell["task"] not in TRACED:
        return {}
    name = "-".join(
        str(cell[key]) for key in ("task", "configuration", "target", "seed", "size", "budget")
    )
    return {"out": RUNS / name.replace(" ", "_").replace("/", "_"), "resume": True}


def cells(arguments: argparse.Namespace, configurations: list[str]) -> Iterator[Row]:
    """All cells, seeds outermost, so that a table can be made before the last is done."""
    scenes = {name: SCENES[name] for name in arguments.tasks or list(SCENES)[:3]}
    seeds = {task: arguments.seeds or scene.seeds for task, scene in scenes.items()}
    for seed in range(max(seeds.values())):
        for task, scene in scenes.items():
            if seed >= seeds[task]:
                continue
            for configuration in configurations:
                yield {
                    "task": task,
                    "target": seed,
                    "configuration": configuration,
                    "seed": seed,
                    "size": arguments.size,
                    "budget": arguments.budget or scene.budget,
                    **scene.options,
                }


def run_encoders(arguments: argparse.Namespace) -> None:
    """Runs of the mean squared error that differ in the encoder."""
    if "random ViT-S/16" in arguments.configurations:
        make_control()
    configurations = [
        configuration
        for configuration in arguments.configurations
        if all(usable("encoder", name) for name in names_of(configuration, arguments.tasks))
    ]
    table = {
        f"encoder {configuration}": ("mse", {"encoder": ENCODERS[configuration]})
        for configuration in configurations
    }
    run_configurations(cells(arguments, list(table)), table, arguments.out, "0/1", measure)


def run_losses(arguments: argparse.Namespace) -> None:
    """Runs that differ in the loss; those of `mse` are those of the encoder `dense`."""
    names = [name for name in LOSSES if name != "mse" and usable("loss", name)]
    table: dict[str, tuple[str, dict[str, Any]]] = {f"loss {name}": (name, {}) for name in names}
    run_configurations(cells(arguments, list(table)), table, arguments.out, "0/1", measure)


def names_of(configuration: str, tasks: list[str]) -> set[str]:
    """Names of the encoders of a configuration, one or one a task."""
    return {for_task(ENCODERS[configuration], task) for task in tasks or list(SCENES)[:3]}


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


def main() -> None:
    """Do what is asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("what", choices=("encoders", "losses", "table", "paired"))
    add("tasks", nargs="*", metavar="TASK", help="voronoi, spline, robot; san_miguel and beads")
    add(
        "--configurations",
        nargs="+",
        default=["dense", "patch", "random ViT-S/16", "dinov3", "efficientnet", "vgg19"],
        choices=list(ENCODERS),
        metavar="CONFIGURATION",
    )
    add("--seeds", type=int)
    add("--budget", type=int)
    add("--pair", nargs=2, default=["dense", "patch"], metavar="ENCODER")
    add("--size", type=int, default=112, metavar="PX")
    add("--out", type=Path, default=RESULTS, metavar="FILE")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.what in ("table", "paired"):
        rows = read(arguments.out)
        paired = arguments.what == "paired"
        print("\n".join(paired_table(rows, *arguments.pair)) if paired else tables(rows))
        return
    {"encoders": run_encoders, "losses": run_losses}[arguments.what](arguments)


if __name__ == "__main__":
    main()
