"""The main comparison of the paper: five scenes, six optimizers, both losses of every result.

    python benchmarks/paper.py --stages mse perceptual loi
    python benchmarks/paper.py --table
    python benchmarks/paper.py --picture docs/images/paper.png

Every run (scene, target, loss, optimizer) is one line of benchmarks/results/paper.jsonl, appended
when it ends; a second call does the missing runs. Slow runs keep a checkpoint beside the file, so
that a call that was interrupted continues in the middle of a run. All optimizers have the same
targets and seed 0. As in the paper, `mse` and `perceptual` both measure the best candidate so far,
whichever loss the optimizer has seen.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from quality import CONFIGURATIONS, Configurations, Row, key, measured, rows_of, run_missing
from scenes import joined, judged
from task_pictures import save

import fide_tasks
from fide_plugins.experiments import run as harness

MARKS = ("1000", "5000", "10000", "25000")
METRICS = ("mse", "perceptual")
SIZE, SEED = 112, 0
PUBLISHED, DIBO = "FIDE paper, 20 epochs", "DiBO, 600 renders"
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
}
STEPS = {"voronoi": 0.01}  # of dual annealing: the best in docs/measurements/baselines.md
USUAL_STEP = 0.001
SLOW = (PUBLISHED, DIBO)
CHEAP = tuple(name for name in RACERS if name not in SLOW)

BUDGETS = {"san_miguel": 10_000, "beads": 5_000}  # a render of Beads takes 80 ms
USUAL_BUDGET = 25_000
AFFORDABLE = {DIBO: 600}  # two minutes
TASK_OPTIONS = {"san_miguel": {"spp": 8}, "beads": {"spp": 16}}
SOLVED = {"voronoi": 1e-3, "robot": 2e-5}  # mean squared errors, as in docs/measurements/moves.md
FAST, RENDERED = ("voronoi", "spline", "robot"), ("san_miguel", "beads")

RESULTS = Path(__file__).parent / "results" / "paper.jsonl"
OLDER = RESULTS.with_name("quality.jsonl")


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
    "published": [
        Stage(("robot", "spline"), ("mse",), (PUBLISHED,), (0,)),
        Stage(("voronoi",), ("perceptual",), (PUBLISHED,), (0,)),
    ],
    "dibo": [Stage(FAST, METRICS, (DIBO,))],
    "rendered": [Stage(RENDERED, ("perceptual",), tuple(RACERS), (0,))],
    "rest": [
        Stage(FAST, (*METRICS, "loi"), (PUBLISHED,)),
        Stage(RENDERED, ("mse",), tuple(RACERS), (0,)),
        Stage(RENDERED, ("loi",), ("FIDE", PUBLISHED), (0,)),
    ],
}


def main() -> None:
    """Run what is missing, or show what was found."""
    arguments = parse_arguments()
    if arguments.table:
        print(table(with_older(rows_of(arguments.out), rows_of(OLDER))))
    elif arguments.picture:
        save(picture(rows_of(arguments.out), arguments.loss), arguments.picture)
    else:
        known = {
            key(row) for row in rows_of(OLDER)
        }  # last, since the table has one of their losses
        cells = sorted(grid(arguments.stages), key=lambda cell: key(cell) in known)
        run = partial(measure, parts=arguments.out.with_suffix(".parts"), threads=arguments.threads)
        run_missing(cells, RACERS, arguments.out, arguments.part, run)


def parse_arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--stages", nargs="+", default=list(STAGES), choices=list(STAGES), help="default: all")
    add("--out", type=Path, default=RESULTS, metavar="FILE")
    add("--part", default="0/1", metavar="I/N", help="the runs of this process")
    add("--threads", type=int, default=1, help="threads of Mitsuba; they change no image")
    add("--table", action="store_true", help="print the tables of the results")
    add("--picture", type=Path, metavar="PNG", help="draw the results of target 0")
    add("--loss", default="perceptual", choices=METRICS, help="loss of the picture")
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
                        "budget": AFFORDABLE.get(configuration, BUDGETS.get(task, USUAL_BUDGET)),
                        **TASK_OPTIONS.get(task, {}),
                    }


def measure(cell: Row, optimizer: str, options: dict[str, Any], parts: Path, threads: int) -> Row:
    """One run: both losses of its best candidate at every mark, and of its result."""
    options = options_of(cell, options)
    place = None
    if cell["configuration"] in SLOW or cell["task"] in RENDERED:
        place = parts / "-".join(str(part) for part in key(cell)).replace(" ", "")
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
    if place is not None:
        shutil.rmtree(place)
    return row


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


def with_older(rows: list[Row], older: list[Row]) -> list[Row]:
    """Rows, and those cells of quality.jsonl that are not among them; these know one loss only."""
    wanted = {key(cell) for cell in grid()} - {key(row) for row in rows}
    found = [row for row in older if key(row) in wanted]
    converted = [
        {**row, "cross": {mark: {"mse": loss} for mark, loss in row["best"].items()}}
        for row in found
    ]
    return rows + converted


def table(rows: list[Row]) -> str:
    """Medians over targets, in Markdown: one table for each scene and each minimized loss."""
    lines: list[str] = []
    without: list[str] = []
    for task in (*FAST, *RENDERED):
        for loss in (*METRICS, "loi"):
            mine = [row for row in rows if (row["task"], loss_of(row)) == (task, loss)]
            planned = {
                cell["configuration"]
                for cell in grid()
                if (cell["task"], cell["loss"]) == (task, loss)
            }
            if mine:
                lines += section(task, loss, mine, [name for name in RACERS if name in planned])
            else:
                without.append(f"{task} `{loss}`")
    if without:
        lines += [f"No run yet: {', '.join(without)}.", ""]
    return "\n".join(lines)


def loss_of(row: Row) -> str:
    """Loss that the optimizer minimized."""
    return str(row.get("loss", "mse"))


def section(task: str, loss: str, rows: list[Row], configurations: list[str]) -> list[str]:
    """One table, a row for each configuration, with "-" for what is missing."""
    paths = f", {TASK_OPTIONS[task]['spp']} paths a pixel" if task in TASK_OPTIONS else ""
    marks = [m for m in MARKS if int(m) <= BUDGETS.get(task, USUAL_BUDGET)]
    columns = ["", "targets", *(f"{name}, {int(m):,}" for name in METRICS for m in marks)]
    columns += ["lowest", "solved"]
    lines = [f"### {task}, minimized `{loss}`{paths}", "", "| " + " | ".join(columns) + " |"]
    lines.append("|---" + "|---:" * (len(columns) - 1) + "|")
    for configuration in configurations:
        group = [row for row in rows if row["configuration"] == configuration]
        cells = [configuration, str(len(group)), *values(group, marks)]
        cells += [lowest(group, rows), solved(group, task)] if group else ["-", "-"]
        lines.append("| " + " | ".join(cells) + " |")
    return [*lines, ""]


def values(rows: list[Row], marks: list[str]) -> list[str]:
    """Medians of both metrics at the marks, at the last one after all renders that a row has.

    (n): only n of the rows have a value.
    """
    cells = []
    for name in METRICS:
        for mark in marks:
            at = [end(row) if mark == marks[-1] else row["cross"].get(mark, {}) for row in rows]
            numbers = [metrics[name] for metrics in at if name in metrics]
            fewer = f" ({len(numbers)})" if len(numbers) < len(rows) else ""
            cells.append(f"{statistics.median(numbers):.3g}{fewer}" if numbers else "-")
    return cells


def end(row: Row) -> dict[str, float]:
    """Metrics after the last render."""
    metrics: dict[str, float] = row["cross"][max(row["cross"], key=int)]
    return metrics


def lowest(group: list[Row], rows: list[Row]) -> str:
    """On how many targets a group has the lowest minimized loss of all rows, where others ran."""
    won = [row for row in group if final(row) == min(final(r) for r in rows if same(r, row))]
    raced = [row for row in group if sum(same(r, row) for r in rows) > 1]
    return f"{len([row for row in won if row in raced])} of {len(raced)}" if raced else "-"


def final(row: Row) -> float:
    """Minimized loss after the last render."""
    return float(row["best"][max(row["best"], key=int)])


def same(a: Row, b: Row) -> bool:
    """Whether two rows are about the same picture."""
    return bool(a["target"] == b["target"])


def solved(group: list[Row], task: str) -> str:
    """How many runs have found the parameters."""
    if task not in SOLVED:
        return "-"
    return f"{sum(end(row)['mse'] <= SOLVED[task] for row in group)} of {len(group)}"


def picture(rows: list[Row], loss: str) -> NDArray[np.float32]:
    """Results of target 0: a row for each scene; each optimizer that has a run, then the target."""
    mine = [row for row in rows if row["target"] == 0 and loss_of(row) == loss and row["x"]]
    found = {(row["task"], row["configuration"]): row for row in mine}
    racers = [name for name in RACERS if any(racer == name for _, racer in found)]
    lines = []
    for task in dict.fromkeys(row["task"] for row in mine):
        scene = make_task(next(row for row in mine if row["task"] == task))
        drawn = [
            scene.reference(np.array(found[task, name]["x"]))
            if (task, name) in found
            else np.ones_like(scene.target)
            for name in racers
        ]
        lines.append(joined([*drawn, scene.target], axis=1))
    return joined(lines, axis=0)


if __name__ == "__main__":
    main()
