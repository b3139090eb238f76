"""Tables of a report, for HTML and a terminal; and as CSV files."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from fide_lab.compare.results import Results
from fide_lab.report.statistics import quantiles
from fide_plugins.recording.record import PARTS

if TYPE_CHECKING:
    from fide_lab.report.panel import Panel, Row

LARGEST_RATIO = 1000
"""Of two losses, that a table writes out."""


class Strong(str):
    """Text of a table that is set in bold."""


@dataclass(frozen=True)
class Table:
    """A table; columns: (name, explanation) of each; rows: texts, of which the first is a name."""

    caption: str
    columns: Sequence[tuple[str, str]]
    rows: Sequence[Sequence[str]]


def markdown(table: Table) -> str:
    """The table in Markdown, with aligned columns and names as they are."""
    texts = [[title for title, _ in table.columns]]
    for row in table.rows:
        texts.append([f"**{text}**" if isinstance(text, Strong) else text for text in row])
    widths = [max(3, *map(len, column)) for column in zip(*texts, strict=True)]
    rule = ["-" * widths[0], *(f"{'-' * (width - 1)}:" for width in widths[1:])]
    lines = []
    for first, *rest in (texts[0], rule, *texts[1:]):
        aligned = (text.rjust(width) for text, width in zip(rest, widths[1:], strict=True))
        lines.append(f"| {' | '.join([first.ljust(widths[0]), *aligned])} |")
    return "\n".join(lines)


def number(value: float) -> str:
    """Format a number with three significant digits.

    >>> number(0.012345), number(12345), number(float("inf"))
    ('0.0123', '12,345', 'none')
    """
    if not math.isfinite(value):
        return "none"
    return f"{value:,.0f}" if abs(value) >= 1000 or value == int(value) else f"{value:.3g}"


# -- of a panel ------------------------------------------------------------------------------------


def ranking(panel: Panel) -> Table:
    """Losses, success, significance and cost of each configuration, also without a finished run."""
    others = [m for m in _metrics(panel) if m != panel.loss]
    columns = [
        ("optimizer", "name and options"),
        ("runs", "finished runs of those planned"),
        ("renders", "of each run"),
        (f"median {panel.loss}", "over runs, of the final loss; a failed run's is infinite"),
        ("25 to 75 %", "quantiles over runs"),
        *((f"median {name}", "over runs, of the same images") for name in others),
        ("success", f"runs with a final loss of {number(panel.threshold)} or less"),
        ("renders to it", "median over runs; none unless more than half of the runs succeed"),
        ("times winner", "median ratio of the losses of pairs"),
        ("p", "of the Wilcoxon signed-rank test against the winner, adjusted for all rivals"),
        ("seconds", "median wall time of a run"),
    ]
    rows = []
    for row in sorted(panel.every, key=lambda row: (row.median, not row.finals)):
        whole = len(row.runs) == row.planned
        set_as = Strong if row in panel.lowest else str
        losses = [""] * (len(others) + 4)
        if row.finals:
            losses = [
                set_as(number(row.median)),
                _range(row),
                *(number(row.judged(name)) for name in others),
                f"{panel.reached(row)} of {len(row.finals)}",
                number(panel.to_target(row)),
            ]
        rows.append(
            [
                set_as(row.name),
                f"{row.planned}" if whole else f"{len(row.runs)} of {row.planned}",
                number(row.budget) if row.runs else "",
                *losses,
                *_against_winner(panel, row),
                number(row.seconds) if row.runs else "",
            ]
        )
    return Table(f"{panel.name}: results", columns, rows)


def _range(row: Row) -> str:
    low, high = quantiles(row.finals)[[1, 3]].tolist()
    return f"{number(low)} to {number(high)}" if math.isfinite(low) else number(low)


def _against_winner(panel: Panel, row: Row) -> tuple[str, str]:
    if row is panel.winner:
        return "winner" if len(panel.lowest) == 1 else "", ""
    test = panel.against_winner.get(row.label)
    if test is None:
        return "", ""
    mark = " †" if panel.significant(row) else ""
    # a very large ratio only says that the winner has found the answer
    large = test.ratio > LARGEST_RATIO
    ratio = f"over {LARGEST_RATIO:,}" if large else number(test.ratio)
    return "" if math.isnan(test.ratio) else ratio, f"{test.adjusted:.2g}{mark}"


def _metrics(panel: Panel) -> list[str]:
    """Names of the losses that judged the runs of all rows."""
    judged = (run.totals["judged"] for row in panel.rows for run in row.runs)
    return list(dict.fromkeys(name for each in judged for name in each))


# -- CSV: the totals of every run ------------------------------------------------------------------


def results_csv(results: Results) -> str:
    """One line for each run: its losses and its cost, empty if the run is not finished.

    Text that a spreadsheet would read as a formula starts with an apostrophe.
    """
    metrics = results.settings["metrics"]
    names = [
        "task", "loss", "optimizer", "seed", "state", "dim", "renders", "best_loss",
        "best_evaluation", "final_loss", "recommended_loss", *(f"final_{m}" for m in metrics),
        "wall_s", *(f"{part}_s" for part in PARTS), "load",
    ]  # fmt: skip
    rows: list[list[Any]] = []
    for result in results.runs:
        texts = (f"'{text}" if text[:1] in "=+-@\t\r" else text for text in result.key[:3])
        row = [*texts, result.key.seed, result.state]
        if result.curve is not None:
            t = result.totals
            seconds = [t["wall_s"], *(t["times"][part] for part in PARTS)]
            row += [
                t["dim"], t["evaluations"], t["best_loss"], t["best_evaluation"],
                t["reference_loss"], t["recommended_loss"],
                *(t["judged"].get(m) for m in metrics),
                *(round(float(s), 4) for s in seconds), result.run.get("load"),
            ]  # fmt: skip
        rows.append(row + [None] * (len(names) - len(row)))
    return as_csv(names, rows)


def as_csv(names: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """Text of a CSV file."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(names)
    writer.writerows(rows)
    return buffer.getvalue()
