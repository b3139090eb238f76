"""The main comparison of the paper: five scenes, six optimizers, both losses of every result.

The stages `backbones` and `backbones-rendered` add the published method with the features of a
pretrained network, the latter on three pictures of San Miguel; `annealing-step` adds dual annealing
on Robot with another step; `dibo-long` adds DiBO with 10,000 renders, half an hour a run.

    python benchmarks/paper.py --stages mse perceptual loi

Every run (scene, target, loss, optimizer) is one line of benchmarks/results/paper.jsonl, appended
when it ends; a second call does the missing runs. Slow runs keep a checkpoint beside the file, so
that a call that was interrupted continues in the middle of a run. All optimizers have the same
targets and seed 0. `mse` and `perceptual` both measure the best candidate so far, whichever loss
the optimizer has seen. paper_tables.py and paper_curves.py show the results.
"""

from __future__ import annotations

import argparse
import os
import shutil
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from quality import CONFIGURATIONS, Configurations, key, measured, run_configurations
from rows import Row

import fide_tasks
from fide_lab import run as harness
from fide_plugins import losses

METRICS = ("mse", "perceptual")
SIZE, SEED = 112, 0
PUBLISHED = "FIDE paper, 20 epochs"
DIBO, DIBO_LONG = "DiBO, 600 renders", "DiBO, 10,000 renders"
DIBO_OPTIONS = {
    "width": 128, "proxy_width": 64, "batch": 64, "proposals": 2, "precision": "single",
    "schedule": "authors",
}  # fmt: skip
RACERS: Configurations = {
    "FIDE": ("fide", {}),
    PUBLISHED: CONFIGURATIONS[PUBLISHED],
    "CMA-ES, k = 500": CONFIGURATIONS["CMA-ES, k = 500"],
    "dual annealing": ("dual-annealing", {}),
    "ZeroGrads": ("zerograds", {}),
    DIBO: ("dibo", DIBO_OPTIONS),
    DIBO_LONG: ("dibo", DIBO_OPTIONS),
}
PRETRAINED = "FIDE paper, 20 epochs, EfficientNet-Lite0"
BACKBONES: Configurations = {PRETRAINED: ("fide", {"preset": "paper", "encoder": "efficientnet"})}
"""The published method with features of a pretrained network instead of its patches."""
COARSE: Configurations = {"dual annealing, step 0.01": ("dual-annealing", {"step": 0.01})}
"""On Robot, where neither step is clearly the better one."""
STEPS = {"voronoi": 0.01}  # of dual annealing: the best in lab/reports/baselines.md
USUAL_STEP = 0.001
SLOW = (PUBLISHED, PRETRAINED, DIBO, DIBO_LONG)
CHEAP = tuple(name for name in RACERS if name not in SLOW)
RENDERED_RACERS = tuple(name for name in RACERS if name != DIBO_LONG)

BUDGET = 25_000
AFFORDABLE = {DIBO: 600, DIBO_LONG: 10_000}  # two minutes, half an hour
TASK_OPTIONS = {"san_miguel": {"spp": 8}, "beads": {"spp": 16}}
FAST, RENDERED = ("voronoi", "spline", "robot"), ("san_miguel", "beads")

RESULTS = Path(__file__).parent / "results" / "paper.jsonl"


class Stage(NamedTuple):
    """Some cells: every target, scene, loss and configuration, the first outermost."""

    tasks: tuple[str, ...]
    losses: tuple[str, ...]
    configurations: tuple[str, ...]
    targets: tuple[int, ...] = (0, 1, 2)


STAGES = {
    "mse": [Stage(FAST, ("mse",), CHEAP)],
    "perceptual": [Stage(FAST, ("perceptual",), CHEAP)],
    "loi": [Stage(FAST, ("loi",), ("FIDE",))],
    "dibo": [Stage(FAST, METRICS, (DIBO,))],
    "published": [Stage(FAST, (*METRICS, "loi"), (PUBLISHED,))],
    "rendered": [Stage(RENDERED, ("perceptual",), RENDERED_RACERS, (0,))],
    "backbones": [Stage(FAST, ("mse",), (PRETRAINED,))],
    "backbones-rendered": [
        Stage(RENDERED, ("perceptual",), (PRETRAINED,), (0,)),
        Stage(("san_miguel",), ("perceptual",), (PRETRAINED, PUBLISHED), (1, 2)),
    ],
    "rendered-mse": [Stage(RENDERED, ("mse",), RENDERED_RACERS, (0,))],
    "rendered-loi": [Stage(RENDERED, ("loi",), ("FIDE", PUBLISHED), (0,))],
    "annealing-step": [Stage(("robot",), METRICS, tuple(COARSE))],
    "dibo-long": [Stage(FAST, ("mse",), (DIBO_LONG,))],
}


def main() -> None:
    """Run what is missing."""
    arguments = parse_arguments()
    parts = arguments.out.with_suffix(".parts")
    run_configurations(
        grid(arguments.stages),
        {**RACERS, **BACKBONES, **COARSE},
        arguments.out,
        arguments.part,
        partial(measure, parts=parts, threads=arguments.threads),
        partial(clear, parts),
    )


def parse_arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--stages", nargs="+", default=list(STAGES), choices=list(STAGES), help="default: all")
    add("--out", type=Path, default=RESULTS, metavar="FILE")
    add("--part", default="0/1", metavar="I/N", help="the runs of this process, 0/2 or 1/2")
    add("--threads", type=int, default=1, help="threads of Mitsuba; they change no image")
    return parser.parse_args()


def grid(stages: Iterable[str] = STAGES) -> Iterator[Row]:
    """Cells of these stages, each once, in the order in which they run."""
    seen = set()
    for stage in (stage for name in stages for stage in STAGES[name]):
        for cell in cells_of(stage):
            if key(cell) not in seen:
                seen.add(key(cell))
                yield cell


def cells_of(stage: Stage) -> Iterator[Row]:
    """Cells of one stage."""
    for target in stage.targets:
        for task in stage.tasks:
            for loss in stage.losses:
                for configuration in stage.configurations:
                    yield {
                        "task": task,
                        "target": target,
                        "loss": loss,
                        "configuration": configuration,
                        "seed": SEED,
                        "size": SIZE,
                        "budget": AFFORDABLE.get(configuration, BUDGET),
                        **TASK_OPTIONS.get(task, {}),
                    }


def in_main_comparison(row: Row) -> bool:
    """Whether the row is of a racer, on a picture that all of them have."""
    return row["configuration"] in RACERS and (row["task"] in FAST or row["target"] == 0)


def measure(cell: Row, optimizer: str, options: dict[str, Any], parts: Path, threads: int) -> Row:
    """One run: both losses of its best candidate at every mark, and of its result."""
    options, place = options_of(cell, options), part_of(parts, cell)
    result = harness.run(
        cell["task"],
        optimizer,
        cell["loss"],
        cell["budget"],
        cell["seed"],
        size=cell["size"],
        task_seed=cell["target"],
        task_options=task_options(cell, threads),
        options=options,
        out=place,
        resume=place is not None,
        keep=harness.Keep(metrics=METRICS, summary=False),
    )
    row = measured(cell, result)
    answers = {"best": result.x_best, "recommended": result.x_recommended}
    task = make_task(cell, threads)
    row |= {
        "options": options,
        "cross": crossed(result.improvements, result.metrics, row["best"]),
        "judged": {who: judged(task, x) for who, x in answers.items() if x is not None},
        "x": None if result.x_best is None else result.x_best.tolist(),
        "render_ms": round(result.render_s / cell["budget"] * 1e3, 3),
    }
    return row


def judged(task: fide_tasks.Task, x: NDArray[np.float64]) -> dict[str, float]:
    """The two metrics of the reference image of x, (dim,), which no optimizer has seen."""
    image = task.reference(x)
    return {name: float(losses.make(name, task.target)(image[None])[0]) for name in METRICS}


def part_of(parts: Path, cell: Row) -> Path | None:
    """Folder of a run from which it goes on; None for runs of a few minutes."""
    if cell["configuration"] in SLOW or cell["task"] in RENDERED:
        return parts / "-".join(str(part) for part in key(cell)).replace(" ", "")
    return None


def clear(parts: Path, cell: Row) -> None:
    """Remove the folder of a run whose row is in the file."""
    place = part_of(parts, cell)
    if place is not None:
        shutil.rmtree(place, ignore_errors=True)


def options_of(cell: Row, options: dict[str, Any]) -> dict[str, Any]:
    """Options of the optimizer; the steps of dual annealing depend on the scene."""
    if cell["configuration"] == "dual annealing":
        return {"step": STEPS.get(cell["task"], USUAL_STEP)}
    return options


def task_options(cell: Row, threads: int) -> dict[str, int]:
    """Options of the scene."""
    options = {name: cell[name] for name in TASK_OPTIONS.get(cell["task"], {})}
    return options | ({"threads": threads} if cell["task"] in RENDERED else {})


def make_task(cell: Row, threads: int = 1) -> fide_tasks.Task:
    """The scene of a cell."""
    return fide_tasks.make(
        cell["task"], cell["size"], cell["target"], **task_options(cell, threads)
    )


def crossed(
    improvements: NDArray[np.int64], metrics: dict[str, NDArray[np.float64]], marks: Iterable[str]
) -> dict[str, dict[str, float]]:
    """All metrics of the candidate that was the best after so many renders, by mark and name."""
    last = {mark: int(np.searchsorted(improvements, int(mark))) - 1 for mark in marks}
    return {
        mark: {name: float(values[i]) for name, values in metrics.items()}
        for mark, i in last.items()
        if i >= 0
    }


if __name__ == "__main__":
    main()
