"""Tables of a suite: solved problems in all, and of each scene."""

from __future__ import annotations

import numpy as np

from fide_plugins.experiments.report import statistics
from fide_plugins.experiments.report.tables import Entry, Table, number
from fide_plugins.experiments.suite.scores import Scores
from fide_plugins.types import Float64

__all__ = ["by_scene", "mcnemar", "totals"]


def totals(found: Scores, names: list[str]) -> Table:
    """Solved problems of each optimizer at each budget, and p against the best one."""
    columns = [("optimizer", "name and options")]
    cells: list[list[Entry]] = [
        [Entry(name, name, series=s)] for s, name in enumerate(names)
    ]  # rows by optimizer
    for budget in found.budgets:
        columns += [
            (f"solved by {number(budget)}", f"problems of {len(found.problems)}"),
            ("p", "exact McNemar test against the optimizer that solves most, adjusted"),
        ]
        solved = found.solved(budget)
        counts = solved.sum(axis=0)
        best = int(counts.argmax())
        rivals = [s for s in range(len(names)) if s != best]
        p = statistics.adjusted([mcnemar(solved[:, best], solved[:, s]) for s in rivals])
        of = dict(zip(rivals, p, strict=True))
        for s, row in enumerate(cells):
            row.append(Entry(f"{counts[s]:.0f}", float(counts[s]), counts[s] == counts.max() > 0))
            row.append(Entry(f"{of[s]:.2g}", of[s]) if s in of else Entry("", -1.0))
    caption = f"Problems solved, of {len(found.problems)}"
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


def mcnemar(a: Float64, b: Float64) -> float:
    """Two-sided p of the exact McNemar test of two optimizers; a, b: (P,), 1 where solved."""
    from scipy import stats

    only_a, only_b = int(((a == 1) & (b == 0)).sum()), int(((a == 0) & (b == 1)).sum())
    if only_a + only_b == 0:
        return 1.0
    return float(stats.binomtest(only_a, only_a + only_b).pvalue)
