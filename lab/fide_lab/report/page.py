"""The report of a comparison: what it shows of each task and loss, and a table of all runs."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Sequence
from typing import Any

from fide_lab.compare.plan import RunKey, target_file
from fide_lab.compare.results import AXES, NoResultsError, Results
from fide_lab.report import plots, sentences, tables
from fide_lab.report.document import Document, Picture, Section, Written, companion, page_path
from fide_lab.report.panel import Panel, panels
from fide_plugins.errors import OptionError
from fide_plugins.runtime import files


def write(
    results: Results,
    page: str | os.PathLike[str],
    thresholds: dict[str, float] | None = None,
) -> Written:
    """Write the page, and results.csv beside it.

    page: path of report.html; the table of a.html is a-results.csv.
    thresholds: loss that counts as success, by "task/loss" or "loss"; by default the second best
        median of a panel.

    Raises NoResultsError (a FileNotFoundError) if no run is finished, AllFailedError (one of them)
    if some failed, OptionError (a ValueError) for a page without the suffix .html or a threshold of
    a loss that was not compared, DependencyError (an ImportError) without Jinja2, OSError if a file
    cannot be written.
    """
    path = page_path(page)
    check_thresholds(thresholds or {}, [run.key for run in results.runs])
    found = panels(results, thresholds or {})
    results.check()
    if not found:
        raise NoResultsError(f"no run in {results.path} is finished; run: fide compare --resume")
    remarks = [*sentences.without_results(results), *sentences.not_shown(results.not_shown)]
    tasks = ", ".join(dict.fromkeys(panel.task for panel in found))
    document = Document(
        f"Comparison: {tasks}",
        [_facts(results, found), *remarks],
        [sentences.command(call) for call in results.calls],
        [*(_section(results, panel) for panel in found), *_unfinished(results)],
        sentences.METHOD,
        _origin(results),
    )
    document.write(path)
    files.write_text(companion(path, "results.csv"), tables.results_csv(results))
    overview = [
        f"{panel.name}: {sentences.summary(panel)}\n\n{tables.markdown(tables.ranking(panel))}"
        for panel in found
    ]
    return Written(path, "\n\n".join([*overview, *remarks]) + "\n")


def check_thresholds(thresholds: Collection[str], runs: Iterable[RunKey]) -> None:
    """Raise OptionError for a threshold of what is none of the runs' "loss" or "task/loss"."""
    known = {name for key in runs for name in (key.loss, f"{key.task}/{key.loss}")}
    for name in thresholds:
        if name not in known:
            raise OptionError(
                f"a threshold is given for {name!r}, which is not compared; choose from "
                f"{', '.join(sorted(known))}"
            )


def _facts(results: Results, found: Sequence[Panel]) -> str:
    budgets = sorted({row.budget for panel in found for row in panel.rows})
    renders = " to ".join(map(tables.number, dict.fromkeys((budgets[0], budgets[-1]))))
    sizes = (run.run["settings"]["size"] for run in results.runs if run.curve is not None)
    pixels = ", ".join(dict.fromkeys(f"{w} x {h}" for h, w in sizes))
    seeds = len({run.key.seed for run in results.runs})
    return (
        f"Optimizers: {len(results.optimizers)}. Seeds: {seeds}. Renders of a run: {renders}. "
        f"Pixels: {pixels}."
    )


def _section(results: Results, panel: Panel) -> Section:
    ends = ", ".join(
        f"{row.name} {tables.number(row.median)}"
        for row in sorted(panel.rows, key=lambda row: row.median)
    )
    about = f"Best {panel.loss} so far on {panel.task}; medians at the end: {ends}."
    curves = {axis: plots.png(plots.convergence(panel, axis)) for axis in AXES}
    images = plots.png(plots.grid(panel, target_file(results.path, panel.task, "png")))
    alt = "Target, best, median and worst run of each optimizer"
    pictures = [Picture(f"{about} Along: {axis}.", png) for axis, png in curves.items()]
    pictures.append(Picture(alt, images))
    said = f"Parameters: {panel.dim}. {sentences.summary(panel)}"
    return Section(panel.name, [said], pictures, [tables.ranking(panel)])


def _unfinished(results: Results) -> list[Section]:
    """The section on runs that are not finished, if there are some."""
    runs = [run for run in results.runs if run.curve is None]
    if not runs:
        return []
    said = (
        f"{len(runs)} of {len(results.runs)} runs are not finished. Those that failed count as "
        "infinite losses; the others are not part of the results above."
    )
    details = [(f"{run.key}: {run.state}", run.why) for run in runs]
    return [Section("Not finished", [said], details=details)]


def _origin(results: Results) -> dict[str, Any]:
    """What made the runs: calls, settings, machine, versions."""
    origin: dict[str, Any] = {}
    for number, call in enumerate(results.calls, start=1):
        where = "a Dask cluster" if call.get("dask") else f"processes: {call.get('jobs', 1)}"
        ended = call["finished"] or "an end that was not recorded"
        origin[f"call {number}"] = f"{where}; from {call['started']} to {ended}"
    settings = {k.replace("_", " "): v for k, v in results.settings.items() if k != "size"}
    return origin | results.machine | results.versions | settings
