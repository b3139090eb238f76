"""Renders to solve each problem of a suite, of the results of a comparison.

A run that failed has solved nothing.  A problem with a missing, unfinished or unplanned run is left
out, since it would say nothing of one optimizer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fide_lab.compare.results import NoResultsError, Results, StoredRun
from fide_lab.suite.definition import Suite, read
from fide_plugins.types import Float64


@dataclass(frozen=True, eq=False)
class Scores:
    """Results of S optimizers on P problems; those that every optimizer has finished or failed.

    labels: of the optimizers.  problems: names.
    budgets: renders at which results are read.
    t: (P, S), renders after which a problem was solved; infinite if it was not.
    losses: (B, P, S), lowest loss by each budget; the error of that candidate where errors judge.
    failed: optimizer and problem of each run that failed.
    left_out: optimizer, problem and state of each run because of which a problem is left out.
        The state is that of a `StoredRun`, or "not planned".
    not_shown: optimizers of the comparison that are none of these.
    """

    suite: Suite
    labels: tuple[str, ...]
    problems: tuple[str, ...]
    budgets: tuple[int, ...]
    t: Float64
    losses: Float64
    failed: tuple[tuple[str, str], ...] = ()
    left_out: tuple[tuple[str, str, str], ...] = ()
    not_shown: tuple[str, ...] = ()

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
        return (self.t <= budget).astype(np.float64)

    def losses_down_to_solved(self) -> Float64:
        """`losses`, but none below the threshold: all who have solved a problem are equal."""
        enough = [self.suite.problem(name)[0].solved for name in self.problems]
        raised: Float64 = np.maximum(self.losses, np.array(enough)[:, None])
        return raised


def scores(results: Results) -> Scores:
    """Scores of a comparison of a suite.

    Raises NoResultsError (a FileNotFoundError) if no problem is finished by all, AllFailedError
    (one of them) if runs failed and none is finished.
    """
    results.check()
    suite = read(results.settings["task_options"]["suite"])
    labels = tuple(results.optimizers)
    table: dict[str, dict[str, StoredRun]] = {}
    for run in results.runs:
        table.setdefault(run.key.task, {})[run.key.configuration] = run
    every = (
        (label, problem, runs[label].state if label in runs else "not planned")
        for label in labels
        for problem, runs in table.items()
    )
    left_out = tuple(one for one in every if one[2] not in ("finished", "failed"))
    open_ = {problem for _, problem, _ in left_out}
    whole = {problem: runs for problem, runs in table.items() if problem not in open_}
    if not whole:
        raise NoResultsError(
            f"no problem in {results.path} is finished by all optimizers; run: fide compare "
            "--resume, or show some of them: fide report --optimizers A,B"
        )
    rows = [[runs[label] for label in labels] for runs in whole.values()]
    ended = [run for row in rows for run in row]
    failed = tuple((r.key.configuration, r.key.task) for r in ended if r.curve is None)
    most = int(results.settings["budget"])
    budgets = (*(b for b in suite.budgets if b < most), most)
    t, losses = np.full((len(rows), len(labels)), np.inf), []
    for b in budgets:
        lowest = np.full(t.shape, np.inf)
        for at, run in np.ndenumerate(np.array(rows, object)):
            scene, _ = suite.problem(run.key.task)
            if run.curve is not None:
                t[at] = run.curve.reaches("renders", scene.solved, scene.metric)
                lowest[at] = run.curve.loss_at("renders", b, scene.metric)
        losses.append(lowest)
    return Scores(
        suite, labels, tuple(whole), budgets, t, np.array(losses), failed, left_out,
        results.not_shown,
    )  # fmt: skip


def data_profile(t: Float64, renders: npt.ArrayLike) -> Float64:
    """Share (m, S) of problems that are solved within each of `renders`, (m,).

    Moré and Wild 2009; COCO's run-time distributions.  A problem that nobody solves counts, too.
    """
    if not len(t):
        raise ValueError("a profile needs at least one problem")
    solved = t[None] <= np.asarray(renders, np.float64)[:, None, None]  # (m, P, S)
    shares: Float64 = (solved & np.isfinite(t)).mean(axis=1)
    return shares


def within(t: Float64, budget: float) -> Float64:
    """t, infinite where it exceeds the budget."""
    return np.where(t <= budget, t, np.inf)
