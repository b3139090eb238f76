"""The page of a suite: profiles, and tables of solved problems and lowest losses."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from fide_lab.compare.results import Results
from fide_lab.report import plots, sentences, statistics
from fide_lab.report.page import Written, companion, environment, page_path
from fide_lab.report.tables import Entry, Table, escaped, markdown, number, plain
from fide_lab.suite.scores import (
    Scores,
    data_profile,
    performance_profile,
    performance_ratios,
    scores,
    within,
)
from fide_plugins.runtime import files
from fide_plugins.runtime.messages import counted
from fide_plugins.types import Float64

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_METHOD = (
    "A problem is a scene and a target. It is solved by the first render whose loss is at most the "
    "threshold of its scene, as the optimizer received the loss. Where an error judges a scene, it "
    "is the error of the best candidate so far, and must stay at most the threshold to the end.",
    "One run of the largest budget is read at each smaller one, so budgets that an optimizer knows "
    "beforehand are the largest.",
    "The data profile (Moré and Wild 2009; COCO) shows the share of problems solved within so many "
    "renders.",
    "The performance profile of a budget (Dolan and Moré 2002) shows the share of problems solved "
    "within the budget and within tau times the renders of the fastest optimizer of that problem. "
    "At tau = 1 it is the share of problems on which an optimizer is fastest, at the right end the "
    "share that it solves.",
    "p is that of the exact McNemar test (a sign test of the problems that one of two optimizers "
    "solves and the other does not) against the optimizer that solves most, adjusted for all "
    "rivals (Benjamini and Hochberg). In brackets: on how many problems that optimizer is ahead of "
    "the one in this row, and on how many it is behind.",
    "An optimizer has the lowest loss on a problem if nobody's is lower; several may share it. The "
    "losses of all who have solved the problem count as equal. p is that of the exact sign test, "
    "which compares two losses on each problem, against the optimizer that has the lowest loss on "
    "most of them, adjusted in the same way.",
    "A run that failed counts as unsolved. Problems with a missing or unfinished run are left out.",
)


class _Chart(NamedTuple):
    """A chart: its file name without a suffix, its title, and the SVG element for the page."""

    stem: str
    title: str
    svg: Any


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
    """Write the page, report.md, solved.csv and figures/ into one folder.

    page: path of report.html.  For another name, the names of the other files start with it:
        a.html, a.md, a-solved.csv.

    Raises OptionError (a ValueError) for a page without the suffix .html, DependencyError (an
    ImportError) without Jinja2, OSError if a file cannot be written.
    """
    path = page_path(page)
    env = environment()  # raises without Jinja2, before anything is written
    names = list(found.labels)  # with all options: pages of a suite are put beside one another
    tables = [
        totals(found, names),
        by_scene(found, names),
        lowest(found, names),
        _thresholds(found),
    ]
    folder = companion(path, "figures")
    charts = _write_charts(found, names, folder)
    pictures = [(quote(f"{folder.name}/{chart.stem}.png"), chart.title) for chart in charts]
    files.write_text(companion(path, "solved.csv"), _csv(found))
    files.write_text(path.with_suffix(".md"), _markdown(origin, found, tables, pictures))
    files.write_text(path, _html(env, origin, found, tables, charts))
    return Written(path, _overview(found, tables))


def _write_charts(found: Scores, names: list[str], folder: Path) -> list[_Chart]:
    """Write the charts as PNG files with a legend; the page has one legend for all of them."""
    folder.mkdir(parents=True, exist_ok=True)
    for stem, _, figure in _figures(found, names, legend=True):
        files.write_bytes(folder / f"{stem}.png", plots.png(figure))
    return [
        _Chart(stem, title, plots.markup(plots.as_file(figure), stem, title))
        for stem, title, figure in _figures(found, names, legend=False)
    ]


def _figures(found: Scores, names: list[str], legend: bool) -> list[tuple[str, str, Any]]:
    """File name, title and figure of the data profile, and of a performance profile a budget."""
    title = "Share of problems solved within so many renders"
    drawn = [("data-profile", title, data_profile_figure(found, names, legend))]
    for budget in found.budgets:
        title = (
            f"Share solved within tau times the renders of the fastest, {number(budget)} renders"
        )
        figure = performance_profile_figure(found, names, budget, legend)
        drawn.append((f"performance-{budget}", title, figure))
    return drawn


def _thresholds(found: Scores) -> Table:
    columns = (
        ("scene", "name in the suite"),
        ("group", "kind of scene"),
        ("loss", "that is minimized"),
        ("solved at", "the loss from which on a problem counts as solved"),
    )
    scenes = [found.suite.scenes[name] for name in found.scenes]
    rows = (
        (Entry(s.name, s.name), Entry(s.group, s.group), Entry(s.loss, s.loss),
         Entry(f"{s.solved:g}", s.solved))
        for s in scenes
    )  # fmt: skip
    return Table("What counts as solved", columns, tuple(rows))


def _facts(found: Scores) -> str:
    optimizers, problems = len(found.labels), len(found.problems)
    budgets = ", ".join(map(number, found.budgets))
    return (
        f"{counted(optimizers, 'optimizer')}, {counted(problems, 'problem')} of "
        f"{counted(len(found.scenes), 'scene')}, read at {budgets} renders"
    )


def _part(found: Scores) -> str:
    """What part of the suite this is."""
    suite = found.suite
    whole = sum(len(scene.targets) for scene in suite.scenes.values())
    scenes = len(suite.scenes)
    if len(found.problems) == whole and found.budgets == suite.budgets:
        return f"This is the whole suite {suite.name}."
    here, all_of_it = (", ".join(map(number, b)) for b in (found.budgets, suite.budgets))
    of_them = "only, of" if set(found.budgets) <= set(suite.budgets) else "in place of"
    budget = "" if here == all_of_it else f"; by {here} renders {of_them} {all_of_it}"
    left_out = [name for name in suite.scenes if name not in found.scenes]
    without = f"; without {', '.join(left_out)}" if left_out else ""
    return (
        f"This is a part of the suite {suite.name}: {len(found.problems)} of {whole} problems, "
        f"{len(found.scenes)} of {scenes} scenes{without}{budget}."
    )


def _csv(found: Scores) -> str:
    """One line for each problem and optimizer."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(
        ["problem", "target", "optimizer", "solved_at", *(f"loss_{b}" for b in found.budgets)]
    )
    for p, problem in enumerate(found.problems):
        for s, label in enumerate(found.labels):
            at = found.t[p, s]
            losses = [f"{loss:.6g}" for loss in found.losses[:, p, s]]
            text = f"{at:.0f}" if np.isfinite(at) else ""
            writer.writerow([problem, found.suite.problem(problem)[1], label, text, *losses])
    return buffer.getvalue()


def _html(
    env: Any, origin: Origin, found: Scores, tables: list[Table], charts: list[_Chart]
) -> str:
    """The page in HTML; env: of `environment`."""
    html: str = env.get_template("suite.html").render(
        title=f"Suite {found.suite.name}",
        facts=_facts(found),
        part=_part(found),
        remarks=remarks(found),
        tables=tables,
        charts=[(chart.title, chart.svg) for chart in charts],
        names=found.labels,
        calls=origin.calls,
        machine=origin.machine,
        versions=origin.versions,
        method=_METHOD,
    )
    return html


def _overview(found: Scores, tables: list[Table]) -> str:
    """The page in short, for a terminal: what part it is, the remarks, and three tables."""
    said = "\n".join([_part(found), *remarks(found)])
    shown = "\n\n".join(plain(table) for table in tables[:3])
    return f"{said}\n\n{shown}\n"


def _markdown(
    origin: Origin, found: Scores, tables: list[Table], pictures: list[tuple[str, str]]
) -> str:
    """The page in Markdown; pictures: link and title of each."""
    calls = (f"    {call}" for call in origin.calls)
    parts = [f"# Suite {found.suite.name}", *calls, _part(found)]
    parts += [*map(escaped, remarks(found)), f"{_facts(found)}."]
    parts += [f"![{escaped(title)}]({link})" for link, title in pictures[:1]]
    for table in tables:
        parts += [f"## {table.caption}", markdown(table)]
    parts += [f"![{escaped(title)}]({link})" for link, title in pictures[1:]]
    parts += ["## How to read it", *_METHOD]
    return "\n\n".join(parts) + "\n"


# -- figures: shares of solved problems ------------------------------------------------------------


def data_profile_figure(found: Scores, names: Sequence[str], legend: bool = True) -> Figure:
    """Figure of the share of problems solved within so many renders (Moré and Wild 2009).

    names: of the optimizers, in the order of found.labels.
    legend: the names are inside of the figure.
    """
    solved = found.t[np.isfinite(found.t)].tolist()
    begin = 0.5 * min([*solved, found.budgets[0]])
    at = np.unique([begin, *solved, float(found.budgets[-1])])
    shares = data_profile(found.t, at)
    return plots.profile(at, shares, names, "renders", legend, found.budgets)


def performance_profile_figure(
    found: Scores, names: Sequence[str], budget: int, legend: bool = True
) -> Figure:
    """Figure of the share solved within tau times the renders of the fastest (Dolan and Moré 2002).

    budget: renders after which a problem counts as unsolved.
    names, legend: as for `data_profile_figure`.
    """
    t = within(found.t, budget)
    ratios = performance_ratios(t)
    tau = np.unique([1.0, *ratios[np.isfinite(ratios)]])
    tau = np.append(tau, max(2.0, 1.3 * tau[-1]))
    shares = performance_profile(t, tau)
    return plots.profile(tau, shares, names, "renders / renders of the fastest optimizer", legend)


# -- tables: solved problems in all and of each scene, and who has the lowest loss -----------------


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


# -- what is said of failed runs, and of what is left out ------------------------------------------

_SHOWN = 5
"""Most problems that are named for one optimizer."""


def remarks(found: Scores) -> list[str]:
    """Sentences on failed runs, on problems and on optimizers that are left out, if there are."""
    said = sentences.not_shown(found.not_shown)
    if found.failed:
        problems = counted(len({problem for _, problem in found.failed}), "problem")
        runs = _listed((label, problem, "failed") for label, problem in found.failed)
        said.append(f"Failed runs count as unsolved, {problems}: {runs}.")
    if found.left_out:
        problems = counted(len({problem for _, problem, _ in found.left_out}), "problem")
        runs = _listed(found.left_out)
        said.append(f"Left out, {problems}: {runs}.")
    if any(status == "not planned" for _, _, status in found.left_out):
        said.append(
            "fide compare --resume adds runs, fide report --optimizers A,B shows only these "
            "optimizers."
        )
    return said


def _listed(runs: Iterable[tuple[str, str, str]]) -> str:
    """Problems by optimizer and status, the first few by name; optimizers with the same at once.

    runs: optimizer, problem and status of each.
    """
    of: dict[tuple[str, str], list[str]] = {}
    for label, problem, status in runs:
        of.setdefault((label, status), []).append(problem)
    groups: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for (label, status), its in of.items():
        groups.setdefault((status, tuple(its)), []).append(label)
    parts = []
    for (status, problems), labels in groups.items():
        more = f" and {len(problems) - _SHOWN} more" if len(problems) > _SHOWN else ""
        verb = _verb(status, len(labels) > 1)
        parts.append(f"{', '.join(labels)} {verb} on {', '.join(problems[:_SHOWN])}{more}")
    return "; ".join(parts)


def _verb(status: str, several: bool) -> str:
    if status == "failed":
        return "failed"
    if status == "not planned":
        return "were not run" if several else "was not run"
    return f"{'are' if several else 'is'} {status}"
