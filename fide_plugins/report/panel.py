"""One panel: a task and a loss, and what can be said of each optimizer there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fide_plugins.compare.results import CellResult, Results
from fide_plugins.harness.record import PARTS
from fide_plugins.report import statistics
from fide_plugins.report.labels import short_names
from fide_plugins.report.statistics import Paired, Success

__all__ = ["SIGNIFICANT", "Panel", "Row", "panels"]

SIGNIFICANT = 0.05
"""Adjusted p below which a difference counts as one."""


@dataclass(frozen=True, eq=False)
class Row:
    """One optimizer; runs: finished ones, at least one, by seed; planned: all there should be.

    arm: its label; name: the same without options that tell it from nobody.
    """

    arm: str
    name: str
    index: int
    runs: tuple[CellResult, ...]
    planned: int

    @cached_property
    def finals(self) -> list[float]:
        """Loss of what each run found."""
        return [run.final for run in self.runs]

    @property
    def median(self) -> float:
        """Median of these."""
        return float(statistics.quantiles(self.finals)[2])

    @property
    def budget(self) -> int:
        """Renders of each run."""
        return int(self.runs[0].totals["evaluations"])

    @property
    def ranked(self) -> list[CellResult]:
        """Runs from best to worst."""
        return sorted(self.runs, key=lambda run: run.final)

    @property
    def typical(self) -> CellResult:
        """The median run; of two the better."""
        return self.ranked[(len(self.runs) - 1) // 2]

    def judged(self, metric: str) -> float:
        """Median of what another loss says of what was found."""
        values = [run.totals["judged"].get(metric) for run in self.runs]
        numbers = [np.inf if value is None else value for value in values]
        return float(statistics.quantiles(numbers)[2])

    def milliseconds(self) -> dict[str, float]:
        """Median time of one evaluation, by `PARTS` and "other"."""
        split = []
        for run in self.runs:
            times = run.totals["times"]
            parts = [times[part] for part in PARTS]
            rest = run.totals["wall_s"] - sum(parts)
            split.append([1e3 * s / run.totals["evaluations"] for s in (*parts, max(0.0, rest))])
        return dict(zip((*PARTS, "other"), np.median(split, axis=0).tolist(), strict=True))

    @property
    def seconds(self) -> float:
        """Median wall time of a run."""
        return float(np.median([run.totals["wall_s"] for run in self.runs]))

    @property
    def rounds(self) -> float:
        """Median number of rounds of parallel renders."""
        return float(np.median([run.totals["rounds"] for run in self.runs]))


@dataclass(frozen=True, eq=False)
class Panel:
    """A task and a loss.

    rows: optimizers that have a finished run, in the order of the plan.
    troubles: cells that are not finished.
    threshold: loss that counts as success; stated: whether the user said so.
    """

    task: str
    loss: str
    dim: int
    rows: tuple[Row, ...]
    troubles: tuple[CellResult, ...]
    threshold: float
    stated: bool

    @property
    def name(self) -> str:
        """For titles."""
        return f"{self.task}, {self.loss}"

    @cached_property
    def winner(self) -> Row:
        """The row with the lowest median."""
        return min(self.rows, key=lambda row: row.median)

    @cached_property
    def against_winner(self) -> dict[str, Paired]:
        """Every other optimizer with at least one seed in common, p adjusted for all of them."""
        tests = {row.arm: self._pairs(row) for row in self.rows if row is not self.winner}
        found = {arm: test for arm, test in tests.items() if test is not None}
        adjusted = statistics.adjusted([test.p for test in found.values()])
        return {
            arm: replace(test, adjusted=p)
            for (arm, test), p in zip(found.items(), adjusted, strict=True)
        }

    def _pairs(self, row: Row) -> Paired | None:
        """Runs of the same seed; where budgets differ, at the end of the smaller one."""
        mine, theirs = ({run.cell.seed: run for run in r.runs} for r in (row, self.winner))
        seeds = sorted(set(mine) & set(theirs))
        if not seeds:
            return None
        ends = min(row.budget, self.winner.budget)
        same = row.budget == self.winner.budget
        a, b = ([_loss(runs[s], None if same else ends) for s in seeds] for runs in (mine, theirs))
        return statistics.paired(a, b)

    def success(self, row: Row) -> Success:
        """How many runs found something at or below the threshold."""
        return Success.of(sum(map(self.succeeded, row.runs)), len(row.runs))

    def succeeded(self, run: CellResult) -> bool:
        """Whether a run found something at or below the threshold."""
        return bool(np.isfinite(run.final)) and run.final <= self.threshold

    def to_target(self, row: Row) -> float:
        """Median number of renders to the threshold; infinity if half of the runs never did."""
        return float(statistics.quantiles([self.renders_to_target(run) for run in row.runs])[2])

    def renders_to_target(self, run: CellResult) -> float:
        """Renders after which a run was at the threshold; infinity if it is no success.

        What it was told may be noisy: a run that was told so only by luck is none, and one that was
        never told so, and yet is one, was there when it rendered what it found.
        """
        if run.curve is None or not self.succeeded(run):
            return np.inf
        found = float(run.totals["best_evaluation"]) + 1.0
        return min(run.curve.reaches("renders", self.threshold), found)

    def significant(self, row: Row) -> bool:
        """Whether the winner is better than this one by more than chance."""
        test = self.against_winner.get(row.arm)
        return test is not None and test.adjusted < SIGNIFICANT and test.effect > 0


def panels(results: Results, thresholds: dict[str, float]) -> list[Panel]:
    """All panels that have a finished run; thresholds by "task/loss" or "loss"."""
    order = list(dict.fromkeys(result.cell.arm for result in results.cells))
    names = short_names(order)
    made = []
    for task, loss in dict.fromkeys((r.cell.task, r.cell.loss) for r in results.cells):
        mine = [r for r in results.cells if (r.cell.task, r.cell.loss) == (task, loss)]
        rows = []
        for index, arm in enumerate(order):
            cells = [r for r in mine if r.cell.arm == arm]
            runs = sorted((r for r in cells if r.curve is not None), key=lambda r: r.cell.seed)
            if runs:
                rows.append(Row(arm, names[arm], index, tuple(runs), len(cells)))
        if rows:
            stated = thresholds.get(f"{task}/{loss}", thresholds.get(loss))
            threshold = _second_best(rows) if stated is None else stated
            troubles = tuple(r for r in mine if r.curve is None)
            dim = int(rows[0].runs[0].totals["dim"])
            made.append(
                Panel(task, loss, dim, tuple(rows), troubles, threshold, stated is not None)
            )
    return made


def _second_best(rows: list[Row]) -> float:
    """The second lowest median, the best anyone but the winner typically reaches."""
    medians = sorted(row.median for row in rows)
    return medians[min(1, len(medians) - 1)]


def _loss(run: CellResult, renders: int | None) -> float:
    """Loss of what a run found, or its best after so many renders."""
    if renders is None or run.curve is None:
        return run.final
    value = float(run.curve.value("renders", [renders])[0])
    return np.inf if np.isnan(value) else value
