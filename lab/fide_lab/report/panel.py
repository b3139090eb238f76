"""A panel: the results of all configurations for one task and one loss.

A run that failed has an infinite loss: its optimizer must not gain by failing.  A missing or
unfinished run is left out, since it says nothing of its optimizer.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fide_lab.compare.plan import split
from fide_lab.compare.results import Results, StoredRun
from fide_lab.report import statistics
from fide_lab.report.statistics import Paired

SIGNIFICANT = 0.05
"""Adjusted p below which a difference is called significant."""


@dataclass(frozen=True, eq=False)
class Row:
    """One configuration.

    label: its label; name: its short name; index: its position in the plan.
    runs, failed: by seed; planned: number of runs in the plan.
    """

    label: str
    name: str
    index: int
    runs: tuple[StoredRun, ...]
    failed: tuple[StoredRun, ...]
    planned: int

    @cached_property
    def finals(self) -> list[float]:
        """Final loss of each run, infinite if it failed."""
        return list(self.losses().values())

    @property
    def median(self) -> float:
        """Median of the final losses; infinite if there are none."""
        return float(statistics.quantiles(self.finals)[2]) if self.finals else np.inf

    @property
    def budget(self) -> int:
        """Renders of each finished run."""
        return int(self.runs[0].totals["evaluations"])

    @property
    def ranked(self) -> list[StoredRun]:
        """Finished runs from best to worst."""
        return sorted(self.runs, key=lambda run: run.final)

    def losses(self, renders: int | None = None) -> dict[int, float]:
        """Final loss of each run by seed, or its best loss after that many renders."""
        found = {run.key.seed: np.inf for run in self.failed}
        for run in self.runs:
            found[run.key.seed] = run.final
            if renders is not None and run.curve is not None:
                found[run.key.seed] = run.curve.loss_at("renders", renders)
        return found

    def judged(self, metric: str) -> float:
        """Median of another loss of the images that the runs found."""
        values = [run.totals["judged"].get(metric) for run in self.runs]
        numbers = [np.inf if value is None else value for value in values]
        return float(statistics.quantiles(self.with_failed(numbers))[2])

    def with_failed(self, values: Sequence[float]) -> list[float]:
        """Values of the finished runs, and infinity for each that failed."""
        return [*values, *[np.inf] * len(self.failed)]

    @property
    def seconds(self) -> float:
        """Median wall time of a run."""
        return float(np.median([run.totals["wall_s"] for run in self.runs]))


@dataclass(frozen=True, eq=False)
class Panel:
    """Results for one task and one loss.

    rows: configurations with a finished run, in the order of the plan; empty: those without one.
    threshold: loss that counts as success, infinite if any finite one does; stated: whether the
        user gave it.
    """

    task: str
    loss: str
    dim: int
    rows: tuple[Row, ...]
    empty: tuple[Row, ...]
    threshold: float
    stated: bool

    @property
    def name(self) -> str:
        """Task and loss, for titles."""
        return f"{self.task}, {self.loss}"

    @cached_property
    def every(self) -> tuple[Row, ...]:
        """All configurations, in the order of the plan."""
        return tuple(sorted((*self.rows, *self.empty), key=lambda row: row.index))

    @cached_property
    def lowest(self) -> tuple[Row, ...]:
        """The rows with the lowest median, in the order of the plan; empty if none is finite."""
        least = min(row.median for row in self.rows)
        return tuple(row for row in self.rows if row.median == least < np.inf)

    @property
    def winner(self) -> Row | None:
        """The first of `lowest`, with which all others are compared; None if there is none."""
        return self.lowest[0] if self.lowest else None

    @cached_property
    def against_winner(self) -> dict[str, Paired]:
        """Paired test against each other row that shares a seed, p adjusted for all tests."""
        winner = self.winner
        if winner is None:
            return {}
        tests = {row.label: _pairs(row, winner) for row in self.every if row is not winner}
        found = {label: test for label, test in tests.items() if test is not None}
        adjusted = statistics.adjusted([test.p for test in found.values()])
        return {
            label: replace(test, adjusted=p)
            for (label, test), p in zip(found.items(), adjusted, strict=True)
        }

    def reached(self, row: Row) -> int:
        """Number of runs whose final loss is at most the threshold."""
        return sum(map(self.succeeded, row.runs))

    def succeeded(self, run: StoredRun) -> bool:
        """Whether the final loss of a run is finite and at most the threshold."""
        return bool(np.isfinite(run.final)) and run.final <= self.threshold

    def to_target(self, row: Row) -> float:
        """Median number of renders to the threshold; infinity if half never reach it."""
        numbers = row.with_failed([self.renders_to_target(run) for run in row.runs])
        return float(statistics.quantiles(numbers)[2])

    def renders_to_target(self, run: StoredRun) -> float:
        """Renders after which a run reached the threshold; infinity if it is no success.

        Losses during the run may be noisy, and success is judged by the final loss.  A run that
        succeeds although no loss was that low counts from the evaluation of its best candidate.
        """
        if run.curve is None or not self.succeeded(run):
            return np.inf
        found = float(run.totals["best_evaluation"]) + 1.0
        return min(run.curve.reaches("renders", self.threshold), found)

    def significant(self, row: Row) -> bool:
        """Whether the winner is significantly better than this row."""
        test = self.against_winner.get(row.label)
        return test is not None and test.adjusted < SIGNIFICANT and 2 * test.worse > test.n


def panels(results: Results, thresholds: dict[str, float]) -> list[Panel]:
    """All panels with a finished run; thresholds by "task/loss" or "loss"."""
    names = short_names(results.optimizers)
    made = []
    for task, loss in dict.fromkeys((r.key.task, r.key.loss) for r in results.runs):
        every = []
        for index, (label, name) in enumerate(names.items()):
            mine = [r for r in results.runs if r.key[:3] == (task, loss, label)]
            mine.sort(key=lambda r: r.key.seed)
            runs = tuple(r for r in mine if r.curve is not None)
            failed = tuple(r for r in mine if r.state == "failed")
            if mine:
                every.append(Row(label, name, index, runs, failed, len(mine)))
        rows = tuple(row for row in every if row.runs)
        empty = tuple(row for row in every if not row.runs)
        if rows:
            stated = thresholds.get(f"{task}/{loss}", thresholds.get(loss))
            threshold = _second_best(every) if stated is None else stated
            dim = int(rows[0].runs[0].totals["dim"])
            made.append(Panel(task, loss, dim, rows, empty, threshold, stated is not None))
    return made


def _second_best(rows: list[Row]) -> float:
    """The second lowest median, of rows with a run that is finished or failed."""
    medians = sorted(row.median for row in rows if row.finals)
    return medians[min(1, len(medians) - 1)]


def _pairs(row: Row, winner: Row) -> Paired | None:
    """Compare runs of the same seed; if budgets differ, at the end of the smaller one."""
    budgets = {each.budget for each in (row, winner) if each.runs}
    end = min(budgets) if len(budgets) > 1 else None
    mine, theirs = row.losses(end), winner.losses(end)
    seeds = sorted(set(mine) & set(theirs))
    if not seeds:
        return None
    return statistics.paired([mine[s] for s in seeds], [theirs[s] for s in seeds])


def short_names(labels: Iterable[str]) -> dict[str, str]:
    """Short name of each label: without the options that all labels of an optimizer share.

    Different labels keep different names, since labels of one optimizer differ in some option.
    """
    words = {label: split(label) for label in labels}
    shared: dict[str, set[str]] = {}
    for name, options in words.values():
        shared[name] = shared.get(name, set(options)) & set(options)
    return {
        label: ":".join([name, *(option for option in options if option not in shared[name])])
        for label, (name, options) in words.items()
    }


def fitted(text: str, room: int) -> str:
    """`text`, cut to at most `room` characters.

    >>> fitted("fide-annealing:budget=2000", 12)
    'fide-anneal…'
    """
    return text if len(text) <= room else text[: room - 1] + "…"
