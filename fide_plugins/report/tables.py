"""Tables of a report: made once, and shown as HTML, as Markdown, and on a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from fide_plugins.harness.parallel import WORKERS
from fide_plugins.harness.record import PARTS
from fide_plugins.report.panel import SIGNIFICANT, Panel, Row

__all__ = ["Entry", "Table", "escaped", "losses", "markdown", "number", "ranking", "times"]


@dataclass(frozen=True)
class Entry:
    """One entry; sort: by what a table is sorted; note: what it says when it is pointed at."""

    text: str
    sort: float | str
    strong: bool = False
    note: str = ""
    series: int | None = None


@dataclass(frozen=True)
class Table:
    """Columns, each with an explanation, and rows of entries."""

    caption: str
    columns: tuple[tuple[str, str], ...]
    rows: tuple[tuple[Entry, ...], ...]


def ranking(panel: Panel) -> Table:
    """What each optimizer reached, how surely, and how fast."""
    budgets = len({row.budget for row in panel.rows}) > 1
    at_the_end = "; where budgets differ, at the end of the smaller one" if budgets else ""
    others = [m for m in _metrics(panel) if m != panel.loss]
    columns = [
        ("optimizer", "with its own options"),
        ("runs", "finished, of those planned"),
        *([("renders", "of each run")] if budgets else []),
        (f"median {panel.loss}", "of what the runs found, judged without noise"),
        ("25 to 75 %", "quantiles over runs"),
        *((f"median {name}", "of the same images") for name in others),
        ("success", f"runs that found {number(panel.threshold)} or less"),
        ("renders to it", "median; none unless more than half of the runs got there"),
        ("times winner", f"median quotient of the losses of pairs{at_the_end}"),
        (
            "p",
            f"Wilcoxon signed-rank test against the winner, adjusted for all rivals; † if below "
            f"{SIGNIFICANT}{at_the_end}",
        ),
        ("effect", "rank-biserial correlation: 1 if worse than the winner in every pair"),
        ("seconds", "median wall time of a run"),
    ]
    rows = tuple(
        (
            _name(row, row is panel.winner),
            _runs(row),
            *([_number(row.budget)] if budgets else []),
            _number(row.median, strong=row is panel.winner),
            _range(row),
            *(_number(row.judged(name)) for name in others),
            _success(panel, row),
            _number(panel.to_target(row)),
            *_against_winner(panel, row),
            _number(row.seconds),
        )
        for row in sorted(panel.rows, key=lambda row: row.median)
    )
    return Table(f"{panel.name}: what was found", tuple(columns), rows)


def times(panel: Panel) -> Table:
    """Where the time goes, and what parallel renders would do."""
    columns = [
        ("optimizer", "with its own options"),
        *((part, f"milliseconds an evaluation, median: {part}") for part in (*PARTS, "other")),
        ("seconds", "median wall time of a run"),
        (f"rounds of {WORKERS}", f"in which {WORKERS} parallel renderers would have done a run"),
        ("speed-up", f"renders a round, at most {WORKERS}"),
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
    return Table(f"{panel.name}: where the time goes", tuple(columns), rows)


def losses(panel: Panel) -> Table:
    """What every run found, a row for each seed."""
    seeds = sorted({run.cell.seed for row in panel.rows for run in row.runs})
    columns = [("seed", "of the optimizer; runs of one seed are a pair")]
    columns += [(row.name, f"{panel.loss} of what the run found") for row in panel.rows]
    rows = []
    for seed in seeds:
        found = [{run.cell.seed: run.final for run in row.runs} for row in panel.rows]
        lowest = min((f[seed] for f in found if seed in f), default=math.inf)
        entries = [_number(f[seed], f[seed] == lowest) if seed in f else _NONE for f in found]
        rows.append((_number(seed), *entries))
    return Table(f"{panel.name}: every run", tuple(columns), tuple(rows))


def markdown(table: Table) -> str:
    """The table in Markdown, columns aligned so that it can be read as it is."""
    cells = [[escaped(title) for title, _ in table.columns]]
    cells += [[escaped(e.text, e.strong) for e in row] for row in table.rows]
    widths = [max(3, *(len(row[i]) for row in cells)) for i in range(len(table.columns))]
    lines = [_line(row, widths) for row in cells]
    rule = [f"{'-' * widths[0]}", *(f"{'-' * (width - 1)}:" for width in widths[1:])]
    return "\n".join([lines[0], _line(rule, widths), *lines[1:]])


def escaped(text: str, strong: bool = False) -> str:
    """Text that Markdown shows as it is."""
    for sign in "\\`*_[]<>|":
        text = text.replace(sign, f"\\{sign}" if sign != "|" else "\\|")
    return f"**{text}**" if strong and text else text


def number(value: float) -> str:
    """A number for people: three digits that count.

    >>> number(0.012345), number(12345), number(float("inf"))
    ('0.0123', '12,345', 'none')
    """
    if not math.isfinite(value):
        return "none"
    return f"{value:,.0f}" if abs(value) >= 1000 or value == int(value) else f"{value:.3g}"


_NONE = Entry("", math.inf)


def _name(row: Row, strong: bool = False) -> Entry:
    return Entry(row.name, row.name, strong, "" if row.name == row.arm else row.arm, row.index)


def _number(value: float, strong: bool = False) -> Entry:
    return Entry(number(value), value if math.isfinite(value) else math.inf, strong)


def _runs(row: Row) -> Entry:
    whole = len(row.runs) == row.planned
    text = f"{row.planned}" if whole else f"{len(row.runs)} of {row.planned}"
    return Entry(text, len(row.runs))


def _range(row: Row) -> Entry:
    from fide_plugins.report.statistics import quantiles

    low, high = quantiles(row.finals)[[1, 3]].tolist()
    return Entry(f"{number(low)} to {number(high)}", high - low if math.isfinite(high) else high)


def _success(panel: Panel, row: Row) -> Entry:
    rate = panel.success(row)
    note = f"95 % interval {rate.low:.0%} to {rate.high:.0%}"
    return Entry(f"{rate.reached} of {rate.n}", rate.reached / rate.n, note=note)


def _against_winner(panel: Panel, row: Row) -> tuple[Entry, Entry, Entry]:
    """Ratio, p and effect."""
    if row is panel.winner:
        return Entry("winner", 1.0), Entry("", -1.0), Entry("", -2.0)
    test = panel.against_winner.get(row.arm)
    if test is None:
        return _NONE, _NONE, _NONE
    mark = " †" if panel.significant(row) else ""
    note = f"worse in {test.worse} of {test.n} pairs; p before adjusting {test.p:.2g}"
    ratio = Entry("", math.inf) if math.isnan(test.ratio) else _number(test.ratio)
    return (
        ratio,
        Entry(f"{test.adjusted:.2g}{mark}", test.adjusted, note=note),
        Entry(f"{test.effect:.2g}", test.effect, note=note),
    )


def _metrics(panel: Panel) -> list[str]:
    """Other losses, by which the runs of all rows were judged."""
    named = (run.totals["judged"] for row in panel.rows for run in row.runs)
    return list(dict.fromkeys(name for judged in named for name in judged))


def _line(cells: Iterable[str], widths: list[int]) -> str:
    first, *rest = zip(cells, widths, strict=True)
    aligned = [first[0].ljust(first[1]), *(text.rjust(width) for text, width in rest)]
    return f"| {' | '.join(aligned)} |"
