"""Tables of a report, for HTML, Markdown and a terminal; and as CSV files."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fide_lab.compare.results import AXES, Results
from fide_lab.report.panel import SIGNIFICANT, Panel, Row
from fide_plugins.recording.record import PARTS, WORKERS

LARGEST_RATIO = 1000
"""Of two losses, that a table writes out."""


@dataclass(frozen=True)
class Entry:
    """One entry; sort: sort key; note: tooltip; series: index of the line style to show."""

    text: str
    sort: float | str
    strong: bool = False
    note: str = ""
    series: int | None = None


@dataclass(frozen=True)
class Table:
    """A table; columns: (name, explanation) of each; rows: entries."""

    caption: str
    columns: tuple[tuple[str, str], ...]
    rows: tuple[tuple[Entry, ...], ...]


def ranking(panel: Panel) -> Table:
    """Losses, success, significance and cost of each configuration, also without a finished run."""
    budgets = len({row.budget for row in panel.rows}) > 1
    at_the_end = "; if budgets differ, at the end of the smaller one" if budgets else ""
    others = [m for m in _metrics(panel) if m != panel.loss]
    columns = [
        ("optimizer", "name and options"),
        ("runs", "finished runs of those planned"),
        *([("renders", "renders of each run")] if budgets else []),
        (
            f"median {panel.loss}",
            "median over runs of the final loss, without noise where the task can render so; a "
            "failed run's is infinite",
        ),
        ("25 to 75 %", "quantiles over runs"),
        *((f"median {name}", "median over runs of the same images") for name in others),
        ("success", f"runs with {_solved(panel)}"),
        ("renders to it", "median over runs; none unless more than half of the runs succeed"),
        (
            "times winner",
            "median ratio of the losses of pairs, without pairs of two infinite losses"
            f"{at_the_end}",
        ),
        (
            "p",
            f"p of the Wilcoxon signed-rank test against the winner, adjusted for all rivals; "
            f"† if below {SIGNIFICANT}{at_the_end}",
        ),
        ("effect", "rank-biserial correlation: 1 if worse than the winner in every pair"),
        ("seconds", "median wall time of a run"),
    ]
    rows = tuple(
        (
            _name(row, row in panel.lowest),
            _runs(row),
            *([_number(row.budget) if row.runs else _NONE] if budgets else []),
            *(_results(panel, row, others) if row.finals else [_NONE] * (len(others) + 4)),
            *_against_winner(panel, row),
            _number(row.seconds) if row.runs else _NONE,
        )
        for row in sorted(panel.every, key=lambda row: (row.median, not row.finals))
    )
    return Table(f"{panel.name}: results", tuple(columns), rows)


def _results(panel: Panel, row: Row, others: Iterable[str]) -> tuple[Entry, ...]:
    """Losses and success of a configuration; others: losses beside the one that is minimized."""
    return (
        _number(row.median, strong=row in panel.lowest),
        _range(row),
        *(_number(row.judged(name)) for name in others),
        _success(panel, row),
        _number(panel.to_target(row)),
    )


def times(panel: Panel) -> Table:
    """Time by part, and the rounds of parallel renders."""
    columns = [
        ("optimizer", "name and options"),
        *((part, f"median milliseconds per evaluation: {part}") for part in (*PARTS, "other")),
        ("seconds", "median wall time of a run"),
        (f"rounds of {WORKERS}", f"rounds of a run with {WORKERS} parallel renderers"),
        ("speed-up", f"renders per round, at most {WORKERS}"),
    ]
    rows = tuple(
        (
            _name(row),
            *(_number(ms) for ms in row.milliseconds().values()),
            _number(row.seconds),
            _number(row.rounds),
            _number(row.budget / max(row.rounds, 1.0)),
        )
        for row in panel.rows
    )
    return Table(f"{panel.name}: time", tuple(columns), rows)


def losses(panel: Panel) -> Table:
    """Final loss of every run, one row for each seed."""
    found = [row.losses() for row in panel.every]
    failed = [{run.key.seed for run in row.failed} for row in panel.every]
    columns = [("seed", "seed of the optimizer; runs with the same seed form a pair")]
    columns += [(row.name, f"final {panel.loss} of the run") for row in panel.every]
    rows = []
    for seed in sorted({seed for finals in found for seed in finals}):
        lowest = min(finals.get(seed, math.inf) for finals in found)
        entries = [
            _FAILED if seed in without else _final(finals.get(seed), lowest)
            for finals, without in zip(found, failed, strict=True)
        ]
        rows.append((_number(seed), *entries))
    return Table(f"{panel.name}: every run", tuple(columns), tuple(rows))


def markdown(table: Table) -> str:
    """The table in Markdown, with aligned columns."""
    return _aligned(table, escaped)


def plain(table: Table) -> str:
    """The table for a terminal: as in Markdown, but names without escapes."""
    return _aligned(table, _bold)


def _aligned(table: Table, written: Callable[[str, bool], str]) -> str:
    texts = [[written(title, False) for title, _ in table.columns]]
    texts += [[written(e.text, e.strong) for e in row] for row in table.rows]
    widths = [max(3, *(len(row[i]) for row in texts)) for i in range(len(table.columns))]
    lines = [_line(row, widths) for row in texts]
    rule = [f"{'-' * widths[0]}", *(f"{'-' * (width - 1)}:" for width in widths[1:])]
    return "\n".join([lines[0], _line(rule, widths), *lines[1:]])


def escaped(text: str, strong: bool = False) -> str:
    """Escape `text` for Markdown; strong: in bold."""
    for sign in "\\`*_[]<>|":
        text = text.replace(sign, f"\\{sign}")
    return _bold(text, strong)


def _bold(text: str, strong: bool) -> str:
    return f"**{text}**" if strong and text else text


def _solved(panel: Panel) -> str:
    finite = math.isfinite(panel.threshold)
    return f"a final loss of {number(panel.threshold)} or less" if finite else "a finite final loss"


def number(value: float) -> str:
    """Format a number with three significant digits.

    >>> number(0.012345), number(12345), number(float("inf"))
    ('0.0123', '12,345', 'none')
    """
    if not math.isfinite(value):
        return "none"
    return f"{value:,.0f}" if abs(value) >= 1000 or value == int(value) else f"{value:.3g}"


_NONE = Entry("", math.inf)
_FAILED = Entry("failed", math.inf)


def _name(row: Row, strong: bool = False) -> Entry:
    return Entry(
        row.name,
        row.name,
        strong,
        "" if row.name == row.label else row.label,
        row.index if row.runs else None,  # without one it is in no chart
    )


def _number(value: float, strong: bool = False) -> Entry:
    return Entry(number(value), value if math.isfinite(value) else math.inf, strong)


def _final(loss: float | None, lowest: float) -> Entry:
    """Final loss of a run, if it is finished; lowest: of the runs with this seed."""
    return _NONE if loss is None else _number(loss, strong=loss == lowest < math.inf)


def _runs(row: Row) -> Entry:
    whole = len(row.runs) == row.planned
    text = f"{row.planned}" if whole else f"{len(row.runs)} of {row.planned}"
    return Entry(text, len(row.runs))


def _range(row: Row) -> Entry:
    from fide_lab.report.statistics import quantiles

    low, high = quantiles(row.finals)[[1, 3]].tolist()
    if not math.isfinite(low):
        return _number(low)
    return Entry(f"{number(low)} to {number(high)}", high - low if math.isfinite(high) else high)


def _success(panel: Panel, row: Row) -> Entry:
    rate = panel.success(row)
    note = f"95 % interval {rate.low:.0%} to {rate.high:.0%}"
    return Entry(f"{rate.reached} of {rate.n}", rate.reached / rate.n, note=note)


def _against_winner(panel: Panel, row: Row) -> tuple[Entry, Entry, Entry]:
    """Ratio, p and effect."""
    if row is panel.winner:
        name = "winner" if len(panel.lowest) == 1 else ""
        return Entry(name, 1.0), Entry("", -1.0), Entry("", -2.0)
    test = panel.against_winner.get(row.label)
    if test is None:
        return _NONE, _NONE, _NONE
    mark = " †" if panel.significant(row) else ""
    note = f"worse in {test.worse} of {test.n} pairs; p before adjusting {test.p:.2g}"
    return (
        _ratio(test.ratio),
        Entry(f"{test.adjusted:.2g}{mark}", test.adjusted, note=note),
        Entry(f"{test.effect:.2g}", test.effect, note=note),
    )


def _ratio(ratio: float) -> Entry:
    """Ratio of losses; a very large one only says that the winner has found the answer."""
    if math.isnan(ratio):
        return _NONE
    return _number(ratio) if ratio <= LARGEST_RATIO else Entry(f"over {LARGEST_RATIO:,}", ratio)


def _metrics(panel: Panel) -> list[str]:
    """Names of the losses that judged the runs of all rows."""
    judged = (run.totals["judged"] for row in panel.rows for run in row.runs)
    return list(dict.fromkeys(name for each in judged for name in each))


def _line(texts: Iterable[str], widths: list[int]) -> str:
    first, *rest = zip(texts, widths, strict=True)
    aligned = [first[0].ljust(first[1]), *(text.rjust(width) for text, width in rest)]
    return f"| {' | '.join(aligned)} |"


# -- CSV: the totals of every run, and its curve at a few marks ------------------------------------

_MARKS_A_DECADE = 12


def results_csv(results: Results) -> str:
    """One line for each run: its losses and its cost, empty if the run is not finished.

    Text that a spreadsheet would read as a formula starts with an apostrophe.
    """
    metrics = results.settings["metrics"]
    names = [
        "task", "loss", "optimizer", "seed", "state", "dim", "renders", "best_loss",
        "best_evaluation", "final_loss", "recommended_loss", *(f"final_{m}" for m in metrics),
        "wall_s", *(f"{part}_s" for part in PARTS), "rounds_of_8", "load",
    ]  # fmt: skip
    rows: list[list[Any]] = []
    for result in results.runs:
        cell = result.key
        row = [
            _text(cell.task),
            _text(cell.loss),
            _text(cell.configuration),
            cell.seed,
            result.state,
        ]
        if result.curve is not None:
            t = result.totals
            row += [
                t["dim"], t["evaluations"], t["best_loss"], t["best_evaluation"],
                t["reference_loss"], t["recommended_loss"],
                *(t["judged"].get(m) for m in metrics), _round(t["wall_s"]),
                *(_round(t["times"][part]) for part in PARTS), t["rounds"], result.run.get("load"),
            ]  # fmt: skip
        rows.append(row + [None] * (len(names) - len(row)))
    return _csv(names, rows)


def curves_csv(results: Results) -> str:
    """The best loss so far of every finished run, at geometrically spaced numbers of renders.

    Rounds are those of eight parallel renders.  Seconds and rounds belong to the evaluation that
    reached the loss.
    """
    names = ["task", "loss", "optimizer", "seed", *AXES, "best_loss", *results.settings["metrics"]]
    rows: list[list[Any]] = []
    for result in results.runs:
        curve, cell = result.curve, result.key
        if curve is None or not len(curve.loss):
            continue
        end = curve.ends["renders"]
        count = 2 + int(_MARKS_A_DECADE * np.log10(max(end, 1)))
        marks = np.unique(np.rint(np.geomspace(1, end, count)))
        index = np.searchsorted(curve.at["renders"], marks, side="right") - 1
        for mark, i in zip(marks.tolist(), index.tolist(), strict=True):
            if i < 0:
                continue
            where = [int(mark), _round(curve.at["seconds"][i]), int(curve.at["rounds"][i])]
            values = [f"{curve.loss[i]:.6g}", *(f"{v[i]:.6g}" for v in curve.metrics.values())]
            rows.append(
                [
                    _text(cell.task),
                    _text(cell.loss),
                    _text(cell.configuration),
                    cell.seed,
                    *where,
                    *values,
                ]
            )
    return _csv(names, rows)


def _csv(names: list[str], rows: list[list[Any]]) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(names)
    writer.writerows(rows)
    return buffer.getvalue()


def _text(text: str) -> str:
    return f"'{text}" if text[:1] in "=+-@\t\r" else text


def _round(seconds: float) -> float:
    return round(float(seconds), 4)
