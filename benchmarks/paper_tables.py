"""Tables and the picture of the paper's main comparison, from the rows of paper.py.

python benchmarks/paper_tables.py
python benchmarks/paper_tables.py --backbones
python benchmarks/paper_tables.py --picture docs/images/paper.png
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from paper import (
    AFFORDABLE,
    FAST,
    METRICS,
    PRETRAINED,
    PUBLISHED,
    RACERS,
    RENDERED,
    RESULTS,
    TASK_OPTIONS,
    grid,
    in_main_comparison,
    make_task,
)
from PIL import Image, ImageDraw, ImageFont
from quality import key
from rows import Row, read
from task_pictures import joined, save

MARKS = ("1000", "5000", "10000", "25000")
SOLVED = {"voronoi": 1e-3, "robot": 2e-5}  # mean squared errors, as in lab/reports/moves.md


def main() -> None:
    """Print the tables, or draw the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=Path, default=RESULTS, metavar="FILE", help="of paper.py")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="draw the results of target 0")
    parser.add_argument("--loss", default="perceptual", choices=METRICS, help="of the picture")
    parser.add_argument("--backbones", action="store_true", help="only the encoders' table")
    arguments = parser.parse_args()
    every = longest(read(arguments.rows))
    rows = list(filter(in_main_comparison, every))
    if arguments.backbones:
        print("\n".join(backbones(every)))
    elif arguments.picture:
        save(picture(rows, arguments.loss), arguments.picture)
    else:
        print(table(rows))


def table(rows: list[Row]) -> str:
    """Medians over targets, in Markdown: one table for each scene and each minimized loss."""
    lines: list[str] = []
    without: list[str] = []
    for task in (*FAST, *RENDERED):
        for loss in (*METRICS, "loi"):
            mine = [row for row in rows if (row["task"], row["loss"]) == (task, loss)]
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


def longest(rows: list[Row]) -> list[Row]:
    """Of the runs that differ in nothing but their renders, those with the most."""
    found: dict[tuple[Any, ...], Row] = {}
    for row in sorted(rows, key=lambda row: row["budget"]):
        found[key({**row, "budget": None})] = row
    return list(found.values())


def section(task: str, loss: str, rows: list[Row], configurations: list[str]) -> list[str]:
    """One table, a row for each configuration, with "-" for what is missing."""
    samples = f", {TASK_OPTIONS[task]['spp']} samples per pixel" if task in TASK_OPTIONS else ""
    most = max(row["budget"] for row in rows)
    marks = [*(m for m in MARKS if int(m) < most), str(most)]
    columns = ["", "lowest", "solved", "targets"]  # these first: a page cuts off what is wide
    columns += [f"{name}, {int(m):,}" for name in METRICS for m in marks]
    lines = [f"### {task}, minimized `{loss}`{samples}", "", "| " + " | ".join(columns) + " |"]
    lines.append("|---" + "|---:" * (len(columns) - 1) + "|")
    for configuration in configurations:
        group = [row for row in rows if row["configuration"] == configuration]
        fewer = "" if configuration in AFFORDABLE else shorter(group, most)
        counts = [lowest(group, rows), solved(group, task)] if group else ["-", "-"]
        cells = [configuration + fewer, *counts, str(len(group)), *values(group, marks)]
        lines.append("| " + " | ".join(cells) + " |")
    return [*lines, ""]


def backbones(rows: list[Row]) -> list[str]:
    """The minimized loss at the marks, target by target, of the encoders that both have run."""
    encoders = {PUBLISHED: "patch", PRETRAINED: "efficientnet"}
    runs: dict[tuple[str, str, int], dict[str, Row]] = {}
    for row in rows:
        if row["configuration"] in encoders:
            cell = runs.setdefault((row["task"], row["loss"], row["target"]), {})
            cell[row["configuration"]] = row
    marks = ", ".join(f"{int(mark):,}" for mark in MARKS)
    lines = [f"| scene, loss, target | encoder | after {marks} renders |", "|---|---|---|"]
    for (task, loss, target), pair in sorted(runs.items()):
        for configuration, encoder in encoders.items() if len(pair) == 2 else ():
            cross = pair[configuration]["cross"]
            numbers = [f"{cross[mark][loss]:.3g}" if mark in cross else "-" for mark in MARKS]
            lines.append(f"| {task}, `{loss}`, {target} | `{encoder}` | {', '.join(numbers)} |")
    return lines


def shorter(rows: list[Row], most: int) -> str:
    """Says so if runs have fewer renders than others."""
    budgets = {row["budget"] for row in rows} - {most}
    return f", {min(budgets):,} renders" if budgets else ""


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
    """Of the targets that others ran, too: on how many the group's loss is the lowest.

    Ties count.
    """
    raced = won = 0
    for row in group:
        rivals = [other for other in rows if other["target"] == row["target"]]
        whole = [r["budget"] for r in rivals if r["configuration"] not in AFFORDABLE]
        mark = min(whole, default=row["budget"])
        raced += len(rivals) > 1
        won += len(rivals) > 1 and loss_at(row, mark) == min(loss_at(r, mark) for r in rivals)
    return f"{won} of {raced}" if raced else "-"


def loss_at(row: Row, mark: int) -> float:
    """Minimized loss after so many renders, or after all if the row has fewer."""
    return float(row["best"][max((m for m in row["best"] if int(m) <= mark), key=int)])


def solved(group: list[Row], task: str) -> str:
    """How many runs have found the parameters."""
    if task not in SOLVED:
        return "-"
    return f"{sum(end(row)['mse'] <= SOLVED[task] for row in group)} of {len(group)}"


def picture(rows: list[Row], loss: str) -> NDArray[np.float32]:
    """Results of target 0: a row for each scene; each optimizer that has a run, then the target."""
    mine = [row for row in rows if (row["target"], row["loss"]) == (0, loss) and row["x"]]
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
    return joined([titles([*racers, "target"], lines[0].shape[1]), *lines], axis=0)


def titles(names: list[str], width: int) -> NDArray[np.float32]:
    """Names of columns of equal width, black on white: (H, width, 3)."""
    image = Image.new("RGB", (width, 16), "white")
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(10)
    for i, name in enumerate(names):
        draw.text(((i + 0.5) * width / len(names), 8), name, "black", font, anchor="mm")
    return np.asarray(image).astype(np.float32) / np.float32(255)


if __name__ == "__main__":
    main()
