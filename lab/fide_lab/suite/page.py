"""The page of a suite: profiles, and tables of solved problems and lowest losses."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np

from fide_lab.compare.results import Results
from fide_lab.report import (
    Written,
    companion,
    page as report_page,
    page_path,
    sentences,
    svg,
)
from fide_lab.report.tables import Entry, Table, escaped, markdown, number, plain
from fide_lab.suite import figures
from fide_lab.suite.remarks import remarks
from fide_lab.suite.scores import Scores, scores
from fide_lab.suite.tables import by_scene, lowest, totals
from fide_plugins.runtime import files
from fide_plugins.runtime.messages import counted

__all__ = ["Origin", "write", "write_scores"]

_METHOD = (
    "A problem is a scene and a target. It is solved by the first render whose loss is at most the "
    "threshold of its scene, as the optimizer received the loss.",
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
    env = report_page.environment()  # raises without Jinja2, before anything is written
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
        files.write_bytes(folder / f"{stem}.png", svg.png(figure))
    return [
        _Chart(stem, title, svg.markup(svg.as_file(figure), stem, title))
        for stem, title, figure in _figures(found, names, legend=False)
    ]


def _figures(found: Scores, names: list[str], legend: bool) -> list[tuple[str, str, Any]]:
    """File name, title and figure of the data profile, and of a performance profile a budget."""
    title = "Share of problems solved within so many renders"
    drawn = [("data-profile", title, figures.data_profile(found, names, legend))]
    for budget in found.budgets:
        title = (
            f"Share solved within tau times the renders of the fastest, {number(budget)} renders"
        )
        figure = figures.performance_profile(found, names, budget, legend)
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
    whole, scenes = len(suite.scenes) * len(suite.targets), len(suite.scenes)
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
    """The page in HTML; env: of `report_page.environment`."""
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
