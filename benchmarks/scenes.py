"""The three rendered scenes: FIDE and CMA-ES with the losses `perceptual` and `mse`.

    python benchmarks/scenes.py robot --part 0/2        # and 1/2 in another process
    python benchmarks/scenes.py san_miguel beads
    python benchmarks/scenes.py --table
    python benchmarks/scenes.py --pictures

Every run (task, loss, optimizer, seed) is one line of benchmarks/results/scenes.jsonl, appended
when it ends; a second call does the missing runs. A seed chooses the target, the optimizer's random
numbers and the renderer's noise. After a run both losses judge its result on the task's reference,
which no optimizer has seen: the best candidate, which with noise is also the luckiest, and the
recommendation.

Robot renders on one core, so two processes may divide the runs by `--part`. Mitsuba uses all cores,
so one process is enough; `--threads` leaves some cores to other programs, and changes no image.
"""

from __future__ import annotations

import argparse
import os
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from quality import CONFIGURATIONS, Configurations, measured, run_configurations
from rows import Row, read
from task_pictures import save

import fide_tasks
from fide_plugins import encoders, losses
from fide_plugins.experiments import run as harness


class Scene(NamedTuple):
    """How a task is run by default."""

    budget: int
    seeds: int
    options: dict[str, int]  # those that make a cell


SCENES = {
    "robot": Scene(10_000, 3, {}),
    "san_miguel": Scene(6_000, 1, {"spp": 8}),
    "beads": Scene(6_000, 1, {"spp": 16}),
}
LOSSES = ("perceptual", "mse")
RIVALS: Configurations = {
    configuration: CONFIGURATIONS[configuration]
    for configuration in ("FIDE", "CMA-ES, default k, restarts", "CMA-ES, k = 50")
}
RESULTS = Path(__file__).parent / "results" / "scenes.jsonl"
GAP = 4  # pixels between the images of a picture


def main() -> None:
    """Run what is missing, or show what was found."""
    arguments = parse_arguments()
    if arguments.table:
        print(table(chosen(arguments)))
    elif arguments.pictures:
        for name in arguments.tasks or SCENES:
            rows = [row for row in chosen(arguments) if row["task"] == name]
            if rows:
                path = arguments.images / f"scenes_{name}.png"
                save(picture(rows), path)
                print(path)
    else:
        cells = list(grid(arguments))

        def run(cell: Row, optimizer: str, options: dict[str, Any]) -> Row:
            return measure(cell, optimizer, options, arguments.threads)

        run_configurations(cells, RIVALS, arguments.out, arguments.part, run)


def parse_arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("tasks", nargs="*", metavar="TASK", help="robot, san_miguel, beads")
    add("--losses", nargs="+", default=list(LOSSES), choices=losses.names(), metavar="LOSS")
    add(
        "--configurations",
        nargs="+",
        default=list(RIVALS),
        choices=list(RIVALS),
        metavar="CONFIGURATION",
    )
    add("--seeds", type=int, nargs="+", help="0 1 2 for robot, 0 for the others")
    add("--size", type=int, default=112, metavar="PX")
    add("--budget", type=int, help="renders; 10,000 for robot, 6,000 for the others")
    add("--spp", type=int, help="paths per pixel; 8 for san_miguel, 16 for beads")
    add("--out", type=Path, default=RESULTS, metavar="FILE")
    add("--part", default="0/1", metavar="I/N", help="the runs of this process")
    add("--threads", type=int, help="threads of Mitsuba; default: all cores")
    add("--table", action="store_true", help="print the table of the results")
    add("--pictures", action="store_true", help="draw the pictures of the results")
    add("--images", type=Path, default=Path("docs/images"), metavar="DIR")
    arguments = parser.parse_args()
    unknown = set(arguments.tasks) - set(SCENES)
    if unknown:
        parser.error(f"a task is one of {', '.join(SCENES)}, not {', '.join(sorted(unknown))}")
    return arguments


def chosen(arguments: argparse.Namespace) -> list[Row]:
    """Rows of the tasks and configurations that were asked for, in the order of the latter."""
    rows = [row for row in read(arguments.out) if row["task"] in (arguments.tasks or SCENES)]
    order = {configuration: i for i, configuration in enumerate(arguments.configurations)}
    return sorted(
        (row for row in rows if row["configuration"] in order),
        key=lambda row: order[row["configuration"]],
    )


def grid(arguments: argparse.Namespace) -> Iterator[Row]:
    """All cells, seeds outermost, so that a table can be made before the last is done."""
    tasks = {name: SCENES[name] for name in arguments.tasks or SCENES}
    for seed in arguments.seeds or range(max(scene.seeds for scene in tasks.values())):
        for task, scene in tasks.items():
            if not arguments.seeds and seed >= scene.seeds:
                continue
            for loss in arguments.losses:
                for configuration in arguments.configurations:
                    yield {
                        "task": task,
                        "target": seed,
                        "loss": loss,
                        "configuration": configuration,
                        "seed": seed,
                        "size": arguments.size,
                        "budget": arguments.budget or scene.budget,
                        **{name: arguments.spp or n for name, n in scene.options.items()},
                    }


def measure(cell: Row, optimizer: str, options: dict[str, Any], threads: int | None = None) -> Row:
    """One run: its best loss at every mark, and the judgment of what it found."""
    task = make_task(cell, threads)
    result = harness.run(
        task, optimizer, cell["loss"], cell["budget"], cell["seed"], options=options
    )
    answers = {"best": result.x_best, "recommended": result.x_recommended}
    return {
        **measured(cell, result),
        "judged": {who: judged(task, x) for who, x in answers.items() if x is not None},
        "x": {who: x.tolist() for who, x in answers.items() if x is not None},
        "versions": versions(cell["loss"], task.target),
        "render_ms": round(result.render_s / cell["budget"] * 1e3, 3),
    }


def make_task(cell: Row, threads: int | None = None) -> fide_tasks.Task:
    """The task of a cell."""
    options = {name: cell[name] for name in SCENES[cell["task"]].options}
    if threads is not None and "threads" in fide_tasks.options(cell["task"]):
        options["threads"] = threads
    return fide_tasks.make(cell["task"], cell["size"], cell["target"], **options)


def versions(loss: str, target: NDArray[np.float32]) -> dict[str, str]:
    """What the numbers depend on besides the options."""
    named = {"loss": losses.make(loss, target), "encoder": encoders.make("dense")}
    return {what: str(getattr(part, "version", loss)) for what, part in named.items()}


def judged(task: fide_tasks.Task, x: NDArray[np.float64]) -> dict[str, float]:
    """Both losses of the reference image of x, (dim,)."""
    image = task.reference(x)
    return {name: float(losses.make(name, task.target)(image[None])[0]) for name in LOSSES}


def table(rows: list[Row]) -> str:
    """Medians over seeds, in Markdown; losses in thousandths, of the recommendation in ()."""
    lines: list[str] = []
    for title in dict.fromkeys(map(kind, rows)):
        mine = [row for row in rows if kind(row) == title]
        marks = sorted(map(int, mine[0]["best"]))
        columns = ["", "runs", *(f"{m:,}" for m in marks)]
        columns += [f"judged `{name}`" for name in LOSSES]
        lines += [f"### {title}", ""]
        lines += ["| " + " | ".join(columns) + " |", "|---" + "|---:" * (len(columns) - 1) + "|"]
        for configuration in dict.fromkeys(row["configuration"] for row in mine):
            group = [row for row in mine if row["configuration"] == configuration]
            best = [thousandths(row["best"][str(m)] for row in group) for m in marks]
            cells = [
                configuration,
                str(len(group)),
                *best,
                *(verdict(group, name) for name in LOSSES),
            ]
            lines.append("| " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join(lines)


def kind(row: Row) -> str:
    """What the rows of one table have in common, as its title."""
    paths = f" {row['spp']} paths a pixel," if "spp" in row else ""
    size, budget = row["size"], row["budget"]
    return f"{row['task']}, `{row['loss']}`, {size}x{size},{paths} {budget:,} renders"


def verdict(rows: list[Row], loss: str) -> str:
    """Judged loss of the best candidate, and in parentheses of the recommendation."""
    best = thousandths(row["judged"]["best"][loss] for row in rows)
    return f"{best} ({thousandths(row['judged']['recommended'][loss] for row in rows)})"


def thousandths(values: Iterator[float]) -> str:
    """Median."""
    return f"{1e3 * statistics.median(values):.3g}"


def picture(rows: list[Row]) -> NDArray[np.float32]:
    """Start, best candidate of each optimizer, target; a row for each loss, of the first seed."""
    first = min(row["seed"] for row in rows)
    rows = [row for row in rows if row["seed"] == first]
    task = make_task(rows[0])
    start, target = task.reference(np.full(task.dim, 0.5)), task.target
    configurations = list(dict.fromkeys(row["configuration"] for row in rows))
    found = {(row["loss"], row["configuration"]): row["x"]["best"] for row in rows}
    lines = []
    for loss in dict.fromkeys(row["loss"] for row in rows):
        middle = [found.get((loss, configuration)) for configuration in configurations]
        best = [np.ones_like(target) if x is None else task.reference(x) for x in middle]
        lines.append(joined([start, *best, target], axis=1))
    return joined(lines, axis=0)


def joined(images: list[NDArray[np.float32]], axis: int) -> NDArray[np.float32]:
    """Images side by side or one below the other, with a white gap between them."""
    shape = list(images[0].shape)
    shape[axis] = GAP
    gap = np.ones(shape, np.float32)
    return np.concatenate([part for image in images for part in (gap, image)][1:], axis=axis)


if __name__ == "__main__":
    main()
