"""The curves of the paper's main comparison: both losses of the best candidate against renders.

    python benchmarks/paper_curves.py --csv benchmarks/results/paper.csv
    python benchmarks/paper_curves.py --picture docs/images/paper_curves.png

The rows are those of `benchmarks/paper.py`, which keeps both losses at eight numbers of renders. A
row of figures is a scene; the columns are the two losses of runs that minimized `mse`, then of runs
that minimized `perceptual`. Lines are medians over the targets, bands go from the lowest to the
highest.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from paper import FAST, METRICS, RACERS, RENDERED, RESULTS, in_main_comparison
from paper_tables import end, longest
from quality import MARKS
from rows import Row, read

from fide_lab.report import plots
from fide_plugins.types import Float64

COLUMNS = ("scene", "minimized", "optimizer", "target", "renders", *METRICS)


def lines(rows: Sequence[Row]) -> Iterator[tuple[Any, ...]]:
    """Lines of the CSV file: an optimizer's best candidate on a target, after so many renders."""
    for row in rows:
        for mark, metrics in row["cross"].items():
            values = (f"{metrics[name]:.6g}" if name in metrics else "" for name in METRICS)
            yield (
                row["task"], row["loss"], row["configuration"], row["target"], int(mark), *values,
            )  # fmt: skip


def curves(rows: Sequence[Row], metric: str) -> tuple[Float64, Float64]:
    """Marks (m,) that all runs have reached, and a metric there, (m, runs)."""
    marks = [mark for mark in MARKS if all(str(mark) in row["cross"] for row in rows)]
    values = [[row["cross"][str(mark)][metric] for row in rows] for mark in marks]
    return np.array(marks, float), np.array(values)


def picture(rows: Sequence[Row]) -> Figure:
    """Figure of all scenes."""
    scenes = [task for task in (*FAST, *RENDERED) if any(row["task"] == task for row in rows)]
    columns = [(loss, metric) for loss in METRICS for metric in METRICS]
    figure = Figure(figsize=(11, 2.1 * len(scenes)), layout="constrained")
    grid = figure.subplots(len(scenes), len(columns), squeeze=False)
    for task, line in zip(scenes, grid, strict=True):
        for axes, (loss, metric) in zip(line, columns, strict=True):
            mine = [row for row in rows if (row["task"], row["loss"]) == (task, loss)]
            draw(axes, mine, metric)
        line[0].annotate(
            task, (-0.34, 0.5), xycoords="axes fraction", rotation=90, va="center", fontsize=10
        )
    for axes, (loss, metric) in zip(grid[0], columns, strict=True):
        axes.set_title(f"minimized {loss}:\n{metric}", fontsize=9)
    for axes in grid[-1]:
        axes.set_xlabel("renders", fontsize=9)
    handles = [
        Line2D([], [], color=plots.style(i).color, label=name)
        for i, name in enumerate(RACERS)
        if any(row["configuration"] == name for row in rows)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=9, frameon=False)
    return figure


def draw(axes: Any, rows: Sequence[Row], metric: str) -> None:
    """Medians and bands of the optimizers in one figure; a run of one mark is a point."""
    if not rows:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "not run", color=plots.MUTED, ha="center", transform=axes.transAxes)
        return
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(0.8 * MARKS[0], 1.25 * MARKS[-1])
    axes.xaxis.set_minor_formatter("")
    axes.tick_params(which="both", labelsize=7)
    axes.grid(color=plots.MUTED, alpha=0.2)
    for i, name in enumerate(RACERS):
        group = [row for row in rows if row["configuration"] == name and metric in end(row)]
        if not group:
            continue
        renders, values = curves(group, metric)
        color = plots.style(i).color
        marker = "o" if len(renders) == 1 else ""
        axes.plot(renders, np.median(values, axis=1), color=color, marker=marker, markersize=4)
        axes.fill_between(renders, values.min(1), values.max(1), color=color, alpha=0.15, lw=0)


def main() -> None:
    """Write the file or the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=Path, default=RESULTS, metavar="FILE", help="of paper.py")
    parser.add_argument("--csv", type=Path, metavar="FILE")
    parser.add_argument("--picture", type=Path, metavar="PNG")
    arguments = parser.parse_args()
    rows = longest(read(arguments.rows))
    if arguments.csv:
        with arguments.csv.open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerows([COLUMNS, *lines(rows)])
    if arguments.picture:
        picture(list(filter(in_main_comparison, rows))).savefig(arguments.picture, dpi=90)


if __name__ == "__main__":
    main()
