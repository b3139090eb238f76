"""Renders to solve each problem of a suite, of the results of a comparison."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fide_plugins.experiments.compare.results import NoResultsError, Results, StoredRun
from fide_plugins.experiments.suite.definition import Suite, read
from fide_plugins.experiments.suite.profiles import within
from fide_plugins.types import Float64

__all__ = ["Scores", "scores"]


@dataclass(frozen=True, eq=False)
class Scores:
    """Results of S optimizers on P problems; those that every optimizer has finished.

    labels: of the optimizers.  problems: names.  planned: number of problems in the plan.
    budgets: renders at which results are read.
    t: (P, S), renders after which a problem was solved; infinite if it was not.
    losses: (B, P, S), lowest loss by each budget.
    """

    suite: Suite
    labels: tuple[str, ...]
    problems: tuple[str, ...]
    planned: int
    budgets: tuple[int, ...]
    t: Float64
    losses: Float64

    @property
    def scenes(self) -> list[str]:
        """Scenes with a problem, in the order of the suite."""
        there = {self.suite.problem(name)[0].name for name in self.problems}
        return [name for name in self.suite.scenes if name in there]

    def of(self, scene: str) -> Float64:
        """Rows of `t` for the problems of a scene."""
        return self.t[[self.suite.problem(name)[0].name == scene for name in self.problems]]

    def solved(self, budget: int) -> Float64:
        """(P, S), 1 where a problem was solved within the budget."""
        return np.isfinite(within(self.t, budget)).astype(np.float64)


def scores(results: Results) -> Scores:
    """Scores of a comparison of a suite; NoResultsError if no problem is finished by all."""
    suite = read(results.settings["task_options"]["suite"])
    labels = tuple(dict.fromkeys(run.key.configuration for run in results.runs))
    table: dict[str, dict[str, StoredRun]] = {}
    for run in results.runs:
        table.setdefault(run.key.task, {})
        if run.curve is not None:
            table[run.key.task][run.key.configuration] = run
    whole = {name: runs for name, runs in table.items() if set(runs) == set(labels)}
    if not whole:
        raise NoResultsError(
            f"no problem in {results.path} is finished by all optimizers; run: fide compare "
            "--resume"
        )
    most = int(results.settings["budget"])
    budgets = (*(b for b in suite.budgets if b < most), most)
    rows = [[runs[label] for label in labels] for runs in whole.values()]
    t = np.array([[_renders(suite, run) for run in row] for row in rows])
    losses = np.array([[[_loss(run, b) for run in row] for row in rows] for b in budgets])
    return Scores(suite, labels, tuple(whole), len(table), budgets, t, losses)


def _renders(suite: Suite, run: StoredRun) -> float:
    assert run.curve is not None, "a finished run has a curve"
    return run.curve.reaches("renders", suite.problem(run.key.task)[0].solved)


def _loss(run: StoredRun, renders: int) -> float:
    assert run.curve is not None, "a finished run has a curve"
    value = float(run.curve.value("renders", [renders])[0])
    return np.inf if np.isnan(value) else value
