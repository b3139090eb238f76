"""Tables of a suite: solved problems in all and of each scene, and who has the lowest loss."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fide_plugins.experiments.report import statistics
from fide_plugins.experiments.report.tables import Entry, Table, number
from fide_plugins.experiments.suite.scores import Scores
from fide_plugins.types import Float64

__all__ = ["by_scene", "lowest", "sign_test", "totals"]


def totals(found: Scores, names: list[str]) -> Table:
    """Solved problems of each optimizer at each budget, and p against the best one."""
    solved = [found.solved(budget) for budget in found.budgets]
    caption = f"Problems solved, of {len(found.problems)}"
    test = "exact McNemar test against the optimizer that solves most, adjusted"
    return _by_budget(found, names, caption, "solved by", solved, solved, test)


def lowest(found: Scores, names: list[str]) -> Table:
    """Problems on which nobody has a lower loss, at each budget, and p against the best one."""
    losses = list(found.losses_down_to_solved())
    first = [(x <= x.min(axis=1, keepdims=True)) & np.isfinite(x) for x in losses]
    caption = f"Problems with the lowest loss, of {len(found.problems)}"
    test = "sign test of losses against the optimizer that has the lowest most often, adjusted"
    return _by_budget(found, names, caption, "lowest by", first, [-x for x in losses], test)


def _by_budget(
    found: Scores,
    names: list[str],
    caption: str,
    heading: str,
    counted: Sequence[NDArray[Any]],
    compared: Sequence[Float64],
    test: str,
) -> Table:
    """Counts of problems and p by budget; both lists have arrays (P, S), one a budget.

    counted: 1 for a problem that counts.  compared: what the test compares, the higher the better.
    """
    columns = [("optimizer", "name and options")]
    cells: list[list[Entry]] = [
        [Entry(name, name, series=s)] for s, name in enumerate(names)
    ]  # rows by optimizer
    for budget, these, values in zip(found.budgets, counted, compared, strict=True):
        columns += [
            (f"{heading} {number(budget)}", f"problems of {len(found.problems)}"),
            ("p", test),
        ]
        counts = these.sum(axis=0)
        best = int(counts.argmax())
        rivals = [s for s in range(len(names)) if s != best]
        p = statistics.adjusted([sign_test(values[:, best], values[:, s]) for s in rivals])
        of = dict(zip(rivals, p, strict=True))
        for s, row in enumerate(cells):
            row.append(Entry(f"{counts[s]:.0f}", float(counts[s]), counts[s] == counts.max() > 0))
            row.append(Entry(f"{of[s]:.2g}", of[s]) if s in of else Entry("", -1.0))
    return Table(caption, tuple(columns), tuple(tuple(row) for row in cells))


def by_scene(found: Scores, names: list[str]) -> Table:
    """Solved problems of each scene: one column an optimizer, its counts at each budget."""
    marks = " / ".join(number(b) for b in found.budgets)
    columns = [("scene", "name in the suite"), ("problems", "targets that count")]
    columns += [(name, f"problems solved by {marks} renders") for name in names]
    rows = []
    for scene in found.scenes:
        t = found.of(scene)
        counts = np.array([(t <= budget).sum(axis=0) for budget in found.budgets])  # (B, S)
        most = counts[-1].max()
        entries = [
            Entry(" / ".join(map(str, column)), float(column[-1]), column[-1] == most > 0)
            for column in counts.T.tolist()
        ]
        rows.append((Entry(scene, scene), Entry(str(len(t)), len(t)), *entries))
    return Table(f"Problems solved by {marks} renders", tuple(columns), tuple(rows))


def sign_test(a: Float64, b: Float64) -> float:
    """Two-sided p of the exact sign test of pairs (P,); of zeros and ones it is McNemar's test."""
    from scipy import stats

    more, less = int((a > b).sum()), int((a < b).sum())
    return float(stats.binomtest(more, more + less).pvalue) if more + less else 1.0
