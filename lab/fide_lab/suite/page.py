"""The page of a suite: data profile, and tables of solved problems and lowest losses."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from textwrap import shorten
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from fide_lab.compare.results import Results
from fide_lab.report import plots, sentences, statistics
from fide_lab.report.document import Document, Picture, Section, Written, companion, page_path
from fide_lab.report.tables import Strong, Table, as_csv, markdown, number
from fide_lab.suite.scores import Scores, data_profile, scores
from fide_plugins.runtime import files
from fide_plugins.runtime.messages import counted
from fide_plugins.types import Float64

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_METHOD = (
    "A problem is a scene and a target. It is solved by the first render whose loss is at most the "
    "threshold of its scene, as the optimizer received the loss.",
    "One run of the largest budget is read at each smaller one, so budgets that an optimizer knows "
    "beforehand are the largest.",
    "The data profile (Moré and Wild 2009; COCO) shows the share of problems solved within so many "
    "renders.",
    "p is that of the exact McNemar test (a sign test of the problems that one of two optimizers "
    "solves and the other does not) against the optimizer that solves most, adjusted for all "
    "rivals (Benjamini and Hochberg). In brackets: on how many problems that optimizer is ahead of "
    "the one in this row, and on how many it is behind.",
    "An optimizer has the lowest loss on a problem if nobody's is lower; several may share it. The "
    "losses of all who have solved the problem count as equal. p is that of the exact sign test, "
    "against the optimizer that has the lowest loss on most problems, adjusted in the same way.",
    "A run that failed counts as unsolved. Problems with a missing or unfinished run are left out.",
)


class Origin(NamedTuple):
    """What made the runs: command lines, machine, and versions of packages."""

    calls: Sequence[str]
    machine: Mapping[str, Any]
    versions: Mapping[str, str]


def write(results: Results, page: str | os.PathLike[str]) -> Written:
    """Write the page of a comparison.

    Raises NoResultsError (a FileNotFoundError) if no problem is finished by all or every run
    failed, and what `write_scores` raises.
    """
    calls = [sentences.command(call) for call in results.calls]
    return write_scores(scores(results), Origin(calls, results.machine, results.versions), page)


def write_scores(found: Scores, origin: Origin, page: str | os.PathLike[str]) -> Written:
    """Write the page, and solved.csv beside it, for a.html a-solved.csv.

    Raises OptionError (a ValueError) for a page without the suffix .html, DependencyError (an
    ImportError) without Jinja2, OSError if a file cannot be written.
    """
    path = page_path(page)
    names = list(found.labels)  # with all options: pages of a suite are put beside one another
    tables = [totals(found, names), by_scene(found, names), lowest(found, names)]
    said = [_part(found), *remarks(found)]
    title = "Share of problems solved within so many renders"
    profile = Picture(title, plots.png(data_profile_figure(found, names)))
    scenes = [found.suite.scenes[name] for name in found.scenes]
    thresholds = Table(
        "What counts as solved",
        [("scene", ""), ("group", "kind of scene"), ("loss", ""), ("solved at", "")],
        [(s.name, s.group, s.loss, f"{s.solved:g}") for s in scenes],
    )
    facts = (
        f"{counted(len(names), 'optimizer')}, {counted(len(found.problems), 'problem')} of "
        f"{counted(len(scenes), 'scene')}, read at {', '.join(map(number, found.budgets))} renders."
    )
    sections = [Section(table.caption, tables=[table]) for table in [*tables, thresholds]]
    Document(
        f"Suite {found.suite.name}",
        [*said, facts],
        origin.calls,
        [Section(title, pictures=[profile]), *sections],
        _METHOD,
        {**origin.machine, **origin.versions},
    ).write(path)
    files.write_text(companion(path, "solved.csv"), _csv(found))
    shown = "\n\n".join(map(markdown, tables))
    return Written(path, "\n".join(said) + f"\n\n{shown}\n")


def _part(found: Scores) -> str:
    """What part of the suite this is."""
    suite = found.suite
    whole = sum(len(scene.targets) for scene in suite.scenes.values())
    if len(found.problems) == whole and found.budgets == suite.budgets:
        return f"This is the whole suite {suite.name}."
    here, all_of_it = (", ".join(map(number, b)) for b in (found.budgets, suite.budgets))
    budget = "" if here == all_of_it else f"; by {here} renders, of {all_of_it}"
    return (
        f"This is a part of the suite {suite.name}: {len(found.problems)} of {whole} problems, "
        f"{len(found.scenes)} of {len(suite.scenes)} scenes{budget}."
    )


def _csv(found: Scores) -> str:
    """One line for each problem and optimizer."""
    names = ["problem", "target", "optimizer", "solved_at", *(f"loss_{b}" for b in found.budgets)]
    rows = []
    for p, problem in enumerate(found.problems):
        for s, label in enumerate(found.labels):
            at = found.t[p, s]
            solved_at = f"{at:.0f}" if np.isfinite(at) else ""
            losses = (f"{loss:.6g}" for loss in found.losses[:, p, s])
            rows.append([problem, found.suite.problem(problem)[1], label, solved_at, *losses])
    return as_csv(names, rows)


# -- figures: shares of solved problems ------------------------------------------------------------


def data_profile_figure(found: Scores, names: Sequence[str]) -> Figure:
    """Figure of the share of problems solved within so many renders (Moré and Wild 2009).

    names: of the optimizers, in the order of found.labels.
    """
    solved = found.t[np.isfinite(found.t)].tolist()
    begin = 0.5 * min([*solved, found.budgets[0]])
    at = np.unique([begin, *solved, float(found.budgets[-1])])
    return plots.profile(at, data_profile(found.t, at), names, "renders", found.budgets)


# -- tables: solved problems in all and of each scene, and who has the lowest loss -----------------


def totals(found: Scores, names: list[str]) -> Table:
    """Solved problems of each optimizer at each budget, and p against the best one."""
    solved = [found.solved(budget) for budget in found.budgets]
    caption = f"Problems solved, of {len(found.problems)}"
    return _by_budget(found, names, caption, "solved by", solved, solved)


def lowest(found: Scores, names: list[str]) -> Table:
    """Problems on which nobody has a lower loss, at each budget, and p against the best one."""
    losses = list(found.losses_down_to_solved())
    first = [(x <= x.min(axis=1, keepdims=True)) & np.isfinite(x) for x in losses]
    caption = f"Problems with the lowest loss, of {len(found.problems)}"
    return _by_budget(found, names, caption, "lowest by", first, [-x for x in losses])


def _by_budget(
    found: Scores,
    names: list[str],
    caption: str,
    heading: str,
    counted: Sequence[NDArray[Any]],
    values: Sequence[Float64],
) -> Table:
    """A row an optimizer: for each budget how many problems count, and p by the sign test."""
    columns = [("optimizer", "name and options")]
    rows: list[list[str]] = [[name] for name in names]
    for budget, counts, value in zip(found.budgets, counted, values, strict=True):
        columns.append((f"{heading} {number(budget)}", f"problems of {len(found.problems)}"))
        columns.append(("p", "against the optimizer that has most; problems better : worse"))
        sums = counts.sum(axis=0)
        best = int(sums.argmax())
        rivals = [s for s in range(len(names)) if s != best]
        p = statistics.adjusted([sign_test(value[:, best], value[:, s]) for s in rivals])
        of = dict(zip(rivals, p, strict=True))
        for s, row in enumerate(rows):
            text = f"{sums[s]:.0f}"
            row.append(Strong(text) if sums[s] == sums.max() > 0 else text)
            more, less = (value[:, best] > value[:, s]).sum(), (value[:, best] < value[:, s]).sum()
            row.append(f"{of[s]:.2g} ({more} : {less})" if s in of else "")
    return Table(caption, columns, rows)


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
        texts = [" / ".join(map(str, column)) for column in counts.T.tolist()]
        shown = [Strong(x) if n == most > 0 else x for x, n in zip(texts, counts[-1], strict=True)]
        rows.append([scene, str(len(t)), *shown])
    return Table(f"Problems solved by {marks} renders", columns, rows)


def sign_test(a: Float64, b: Float64) -> float:
    """Two-sided p of the exact sign test of pairs (P,); of zeros and ones it is McNemar's test."""
    more, less = int((a > b).sum()), int((a < b).sum())
    return float(stats.binomtest(more, more + less).pvalue) if more + less else 1.0


# -- what is said of failed runs, and of what is left out ------------------------------------------

_SHOWN = 100  # characters of the problems of one optimizer


def remarks(found: Scores) -> list[str]:
    """Sentences on failed runs, on problems and on optimizers that are left out, if there are."""
    said = sentences.not_shown(found.not_shown)
    failed = [(label, problem, "failed") for label, problem in found.failed]
    for what, runs in (("Failed runs count as unsolved", failed), ("Left out", found.left_out)):
        of: dict[str, list[str]] = {}
        for label, problem, status in runs:
            of.setdefault(f"{label} ({status})", []).append(problem)
        parts = [f"{run} on {shorten(', '.join(names), _SHOWN)}" for run, names in of.items()]
        if parts:
            several = counted(len({problem for _, problem, _ in runs}), "problem")
            said.append(f"{what}, {several}: {'; '.join(parts)}.")
    return said
