"""Tables of a suite: solved problems in all and of each scene, and who has the lowest loss."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fide_lab.report import statistics
from fide_lab.report.tables import Entry, Table, number
from fide_lab.suite.scores import Scores
from fide_plugins.types import Float64

__all__ = ["by_scene", "lowest", "sign_test", "totals"]


class _Counted(NamedTuple):
    """What a table counts, and how it compares two optimizers.

    heading: of the columns.  test: what p is.
    counts: (P, S) for each budget, 1 for a problem that counts.
    values: (P, S) for each budget, what the test compares; the higher the better.
    """

    caption: str
    heading: str
    test: str
    counts: Sequence[NDArray[Any]]
    values: Sequence[Float64]


def totals(found: Scores, names: list[str]) -> Table:
    """Solved problems of each optimizer at each budget, and p against the best one."""
    solved = [found.solved(budget) for budget in found.budgets]
    caption = f"Problems solved, of {len(found.problems)}"
    test = "exact McNemar test against the optimizer that solves most, adjusted"
    return _by_budget(found, names, _Counted(caption, "solved by", test, solved, solved))


def lowest(found: Scores, names: list[str]) -> Table:
    """Problems on which nobody has a lower loss, at each budget, and p against the best one."""
    losses = list(found.losses_down_to_solved())
    first = [(x <= x.min(axis=1, keepdims=True)) & np.isfinite(x) for x in losses]
    caption = f"Problems with the lowest loss, of {len(found.problems)}"
    test = "sign test of losses against the optimizer that has the lowest most often, adjusted"
    values = [-x for x in losses]
    return _by_budget(found, names, _Counted(caption, "lowest by", test, first, values))


def _by_budget(found: Scores, names: list[str], what: _Counted) -> Table:
    """Counts by budget; p, and on how many problems the one that counts most is better : worse."""
    columns = [("optimizer", "name and options")]
    rows: list[list[Entry]] = [[Entry(name, name, series=s)] for s, name in enumerate(names)]
    for budget, counts, values in zip(found.budgets, what.counts, what.values, strict=True):
        columns += [
            (f"{what.heading} {number(budget)}", f"problems of {len(found.problems)}"),
            ("p", f"{what.test}; on how many problems that one is better : worse"),
        ]
        sums = counts.sum(axis=0)
        best = int(sums.argmax())
        rivals = [s for s in range(len(names)) if s != best]
        p = statistics.adjusted([sign_test(values[:, best], values[:, s]) for s in rivals])
        of = dict(zip(rivals, p, strict=True))
        for s, row in enumerate(rows):
            row.append(Entry(f"{sums[s]:.0f}", float(sums[s]), sums[s] == sums.max() > 0))
            row.append(_against(values[:, best], values[:, s], of[s]) if s in of else _NO_TEST)
    return Table(what.caption, tuple(columns), tuple(tuple(row) for row in rows))


def _against(best: Float64, other: Float64, p: float) -> Entry:
    """P with the pairs (P,) that it comes from: a small one need not speak for the best."""
    return Entry(f"{p:.2g} ({(best > other).sum()} : {(best < other).sum()})", p)


_NO_TEST = Entry("", -1.0)


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
