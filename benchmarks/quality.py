"""Loss against renders: FIDE, its presets, CMA-ES at three populations and PGPE, in one run.

    python benchmarks/quality.py voronoi spline --out runs/quality.jsonl
    python benchmarks/quality.py --table runs/quality.jsonl

Every run (task, target, optimizer, seed) is one line of the output file, appended when it ends; a
second call does the missing runs.  One thread per process; `--part i/n` divides the runs among n
processes.  All optimizers have the same targets and seeds.
"""

from __future__ import annotations

import argparse
import os
import statistics
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

os.environ.setdefault("OMP_NUM_THREADS", "1")

from rows import Row, read, run_missing

from fide_lab import run as harness
from fide_plugins.recording.record import best_so_far
from fide_plugins.validation.options import parse_key_value

MARKS = (500, 1000, 2000, 4000, 5000, 10_000, 15_000, 20_000, 25_000)
RIVAL = "CMA-ES"
BUDGET = {"voronoi": 25_000, "spline": 15_000}

Configurations: TypeAlias = dict[str, tuple[str, dict[str, Any]]]

NETWORK = {"preset": "paper", "popsize": 100, "epochs": 4}
CONFIGURATIONS: Configurations = {
    "FIDE": ("fide", {}),
    "CMA-ES, default k, restarts": ("cma", {}),
    "CMA-ES, k = 50": ("cma", {"popsize": 50}),
    "CMA-ES, k = 500": ("cma", {"popsize": 500}),
    "PGPE, k = 256": ("pgpe", {}),
    "PGPE, k = 32": ("pgpe", {"popsize": 32}),
    "FIDE fast": ("fide", {"preset": "fast"}),
    "FIDE accurate": ("fide", {"preset": "accurate"}),
    "FIDE paper, 4 epochs": ("fide", {"preset": "paper", "epochs": 4}),
    "FIDE paper, 10 epochs": ("fide", {"preset": "paper", "epochs": 10}),
    "FIDE paper, 20 epochs": ("fide", {"preset": "paper"}),
    "network": ("fide", NETWORK),
    "network of 8 tokens": ("fide", {**NETWORK, "parameter_tokens": 8}),
    "network, bfloat16": ("fide", {**NETWORK, "precision": "bfloat16"}),
}


def main() -> None:
    """Run what is missing, or print the table."""
    arguments = parse_arguments()
    if arguments.table:
        print(table(read(*arguments.table)))
        return
    run_configurations(grid(arguments), CONFIGURATIONS, arguments.out, arguments.part)


def parse_arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("tasks", nargs="*", help="voronoi, spline")
    parser.add_argument(
        "--configurations", nargs="+", default=list(CONFIGURATIONS)[:4], metavar="CONFIGURATION"
    )
    parser.add_argument("--targets", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--size", type=int, default=112)
    parser.add_argument(
        "--task-set", nargs="+", default=[], metavar="KEY=VALUE", help="of the tasks"
    )
    parser.add_argument("--budget", type=int, default=None)
    parser.add_argument("--out", type=Path, default=Path("runs/quality.jsonl"))
    parser.add_argument("--part", default="0/1")
    parser.add_argument("--table", type=Path, nargs="+")
    return parser.parse_args()


def run_configurations(
    cells: Iterable[Row],
    configurations: Configurations,
    out: Path,
    share: str,
    run: Callable[[Row, str, dict[str, Any]], Row] | None = None,
    clear: Callable[[Row], None] = lambda cell: None,
) -> None:
    """Run those of a share "i/n" of the cells that are not in the file yet.

    run: makes the row of a cell with its optimizer and options; None: `measure`.
    clear: see `rows.run_missing`.
    """
    row_of = run or measure
    run_missing(
        cells,
        lambda cell: row_of(cell, *configurations[cell["configuration"]]),
        out,
        key,
        share,
        clear=clear,
    )


def grid(arguments: argparse.Namespace) -> Iterator[Row]:
    """All cells, seeds outermost, so that a table can be made before the last is done."""
    options = dict(parse_key_value(pair) for pair in arguments.task_set)
    more = {"task_options": options} if options else {}
    for seed in range(arguments.seeds):
        for task in arguments.tasks:
            for target in range(arguments.targets):
                for configuration in arguments.configurations:
                    budget = arguments.budget or BUDGET[task]
                    yield {
                        "task": task,
                        "target": target,
                        "configuration": configuration,
                        "seed": seed,
                        "size": arguments.size,
                        "budget": budget,
                        **more,
                    }


def key(row: Row) -> tuple[Any, ...]:
    """What makes a cell; cells of mean squared error and of tasks without noise say no more."""
    names = ("task", "target", "configuration", "seed", "size", "budget")
    options = sorted((name, repr(value)) for name, value in row.get("task_options", {}).items())
    return (*(row[name] for name in names), row.get("loss", "mse"), row.get("spp"), *options)


def measure(cell: Row, optimizer: str, options: dict[str, Any]) -> Row:
    """One run, and its best loss at every mark."""
    result = harness.run(
        cell["task"],
        optimizer,
        "mse",
        cell["budget"],
        cell["seed"],
        size=cell["size"],
        task_seed=cell["target"],
        task_options=cell.get("task_options", {}),
        options=options,
    )
    return measured(cell, result)


def measured(cell: Row, result: harness.RunResult) -> Row:
    """The row of a run that is finished."""
    best = best_so_far(result.losses)
    reached = {m for m in MARKS if m <= cell["budget"]} | {cell["budget"]}
    marks = {str(m): float(best[m - 1]) for m in sorted(reached)}
    overhead = result.overhead_s / cell["budget"] * 1e3
    return {
        **cell,
        "best": marks,
        "overhead_ms": round(overhead, 3),
        "wall_s": round(result.wall_s, 1),
    }


def table(rows: list[Row], order: Iterable[str] = CONFIGURATIONS) -> str:
    """Medians over targets and seeds, in Markdown, with the lead over the best CMA-ES."""
    lines: list[str] = []
    for scene in dict.fromkeys(map(scene_of, rows)):
        mine = [row for row in rows if scene_of(row) == scene]
        lines += [f"### {scene}", ""]
        marks = [m for m in map(str, MARKS) if any(m in row["best"] for row in mine)]
        lines += ["| | runs | " + " | ".join(f"{int(m):,}" for m in marks) + " |"]
        lines += ["|---" * (len(marks) + 2) + "|"]
        configurations = [
            configuration
            for configuration in order
            if any(row["configuration"] == configuration for row in mine)
        ]
        configurations += sorted({row["configuration"] for row in mine} - set(configurations))
        medians = {
            configuration: medians_of(mine, configuration, marks)
            for configuration in configurations
        }
        for configuration in configurations:
            group = [row for row in mine if row["configuration"] == configuration]
            numbers = " | ".join(
                f"{medians[configuration][m]:#.3g}" if m in medians[configuration] else ""
                for m in marks
            )
            lines.append(f"| {configuration} | {len(group)} | {numbers} |")
        if any(configuration.startswith(RIVAL) for configuration in medians):
            lines.append(f"| FIDE / best CMA-ES | | {leads(medians, marks)} |")
        lines.append("")
    return "\n".join(lines)


def scene_of(row: Row) -> str:
    """Task of a row, with its options and size."""
    options = row.get("task_options", {}).items()
    words = [row["task"], *(f"{name} = {value}" for name, value in options)]
    return ", ".join([*words, f"{row['size']}x{row['size']}"])


def medians_of(rows: list[Row], configuration: str, marks: list[str]) -> dict[str, Any]:
    """Median best loss of a configuration at each mark that all of its runs have reached."""
    group = [row["best"] for row in rows if row["configuration"] == configuration]
    reached = [m for m in marks if all(m in best for best in group)]
    return {m: statistics.median(best[m] for best in group) for m in reached}


def leads(medians: dict[str, dict[str, Any]], marks: list[str]) -> str:
    """FIDE's median over the smallest median of any CMA-ES, at each mark."""
    rivals = [configuration for configuration in medians if configuration.startswith(RIVAL)]
    cells = []
    for m in marks:
        best = min(
            (medians[configuration][m] for configuration in rivals if m in medians[configuration]),
            default=None,
        )
        mine = medians.get("FIDE", {}).get(m)
        cells.append("" if best is None or mine is None else f"{mine / best:#.2g}")
    return " | ".join(cells)


if __name__ == "__main__":
    main()
