"""The report: one self-contained HTML page with its style, script, charts and pictures; and files.

Jinja2 escapes all text from files and names.  The only markup that passes unescaped is the SVG of
our own figures, whose text matplotlib has escaped.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from fide_lab.compare.plan import as_file_name, target_file
from fide_lab.compare.results import AXES, AllFailedError, NoResultsError, Results, StoredRun
from fide_lab.report import plots, sentences, tables
from fide_lab.report.panel import Panel, check_thresholds, panels
from fide_plugins.errors import OptionError
from fide_plugins.runtime import files
from fide_plugins.runtime.machine import missing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Chart:
    """A chart along one axis: name of the axis, its title, and the SVG element."""

    axis: str
    title: str
    svg: Any


def render(results: Results, panels: Sequence[Panel], charts: Sequence[dict[str, bytes]]) -> str:
    """The page of a comparison.

    charts: SVG files of each panel: its convergence by axis, and "times".
    """
    env = environment()
    sections = [
        _section(results, panel, files, i)
        for i, (panel, files) in enumerate(zip(panels, charts, strict=True))
    ]
    settings = results.settings | {"size": _sizes(results)}
    tasks = ", ".join(dict.fromkeys(panel.task for panel in panels))
    html: str = env.get_template("comparison.html").render(
        title=f"Comparison: {tasks}",
        sections=sections,
        settings=settings,
        seeds=len({result.key.seed for result in results.runs}),
        optimizers=len(results.optimizers),
        runs=len(results.runs),
        renders=_renders(panels),
        not_shown=sentences.not_shown(results.not_shown),
        unfinished=[run for run in results.runs if run.curve is None],
        calls=[_call(call) for call in results.calls],
        versions=results.versions,
        machine=results.machine,
        load=_load(results.runs),
        method=sentences.METHOD,
    )
    return html


def environment() -> Any:
    """Jinja2 environment with the templates of this package, autoescape, and shared globals.

    Raises DependencyError (an ImportError) if Jinja2 is not installed.
    """
    try:
        import jinja2
        import matplotlib  # noqa: F401  the charts need it: nothing is written without
    except ImportError as error:
        raise missing("report", "a report needs Jinja2") from error
    from markupsafe import Markup

    folder = resources.files("fide_lab.report") / "templates"
    env = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda name: (folder / name).read_text("utf-8")),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    env.globals |= {
        "stylesheet": Markup((folder / "page.css").read_text("utf-8")),
        "script": Markup((folder / "page.js").read_text("utf-8")),
        "style_of": plots.style,
        "series_of": lambda index: index % len(plots.PALETTE),
        "number": tables.number,
    }
    return env


def _section(
    results: Results, panel: Panel, charts: dict[str, bytes], number: int
) -> dict[str, Any]:
    return {
        "panel": panel,
        "anchor": f"panel-{number}",
        "verdict": sentences.verdict(panel),
        "failures": sentences.failures(panel),
        "threshold": sentences.threshold(panel),
        "abbreviations": sentences.abbreviations(panel),
        "charts": [_chart(panel, axis, charts[axis], f"p{number}-{axis}") for axis in AXES],
        "times": plots.markup(charts["times"], f"p{number}-times", plots.describe_times(panel)),
        "ranking": tables.ranking(panel),
        "time_table": tables.times(panel),
        "losses": tables.losses(panel),
        "target": plots.picture(
            target_file(results.path, panel.task, "png"), f"target of {panel.task}", "target"
        ),
        "found": plots.rows_of(panel),
    }


def _chart(panel: Panel, axis: str, file: bytes, name: str) -> Chart:
    title = plots.AXIS_NAMES[axis]
    description = f"{plots.describe(panel)} Along: {title}."
    return Chart(axis, title, plots.markup(file, name, description))


def _call(call: dict[str, Any]) -> dict[str, Any]:
    """A call of the command; "where" describes its processes."""
    where = "on a Dask cluster" if call.get("dask") else f"{call.get('jobs', 1)} processes"
    where = "one process" if where == "1 processes" else where
    where = f"{where}, {call.get('cores')} cores"
    return {**call, "command": sentences.command(call), "where": where}


def _renders(panels: Sequence[Panel]) -> str:
    """Renders of a run, or those of the shortest and of the longest run."""
    budgets = sorted({row.budget for panel in panels for row in panel.rows})
    return " to ".join(map(tables.number, dict.fromkeys((budgets[0], budgets[-1]))))


def _sizes(results: Results) -> str:
    """Width and height of the pictures in pixels; a renderer of the user has a size of its own."""
    recorded = (run.run["settings"]["size"] for run in results.runs if run.curve is not None)
    sizes = dict.fromkeys((width, height) for height, width in recorded)
    return ", ".join(f"{width} \N{MULTIPLICATION SIGN} {height}" for width, height in sizes)


def _load(runs: Sequence[StoredRun]) -> dict[str, float] | None:
    """Median and highest load average of the machine at the end of the runs."""
    recorded = (result.run.get("load") for result in runs if result.curve is not None)
    loads = [load for load in recorded if isinstance(load, int | float)]
    return {"median": float(np.median(loads)), "highest": max(loads)} if loads else None


@dataclass(frozen=True)
class Written:
    """The page that was written; overview: the ranking of every panel, for a terminal."""

    page: Path
    overview: str


def write(
    results: Results,
    page: str | os.PathLike[str],
    thresholds: dict[str, float] | None = None,
) -> Written:
    """Write the page, report.md, results.csv, curves.csv and figures/ into one folder.

    page: path of report.html.  For another name, the names of the other files start with it:
        a.html, a.md, a-results.csv.
    thresholds: loss that counts as success, by "task/loss" or "loss"; by default the second best
        median of a panel.

    Raises NoResultsError (a FileNotFoundError) if no run is finished, AllFailedError (one of them)
    if some failed, OptionError (a ValueError)
    for a page without the suffix .html or a threshold of a loss that was not compared,
    DependencyError (an ImportError) without Jinja2, OSError if a file cannot be written.
    """
    path = page_path(page)
    check_thresholds(thresholds or {}, [run.key for run in results.runs])
    found = panels(results, thresholds or {})
    AllFailedError.check(results)
    if not found:
        raise NoResultsError(f"no run in {results.path} is finished; run: fide compare --resume")
    environment()  # raises without Jinja2, before anything is written
    figures = companion(path, "figures")
    figures.mkdir(parents=True, exist_ok=True)
    charts = [_write_figures(results, panel, figures) for panel in found]
    files.write_text(companion(path, "results.csv"), tables.results_csv(results))
    files.write_text(companion(path, "curves.csv"), tables.curves_csv(results))
    files.write_text(path.with_suffix(".md"), _markdown(results, found, figures.name))
    files.write_text(path, render(results, found, charts))
    parts = [*map(_in_terminal, found), *_beside(results)]
    return Written(path, "\n\n".join(parts) + "\n")


def page_path(page: str | os.PathLike[str]) -> Path:
    """Path of a page; OptionError (a ValueError) without the suffix .html."""
    path = Path(page)
    if path.suffix.lower() not in (".html", ".htm"):
        raise OptionError(f"the page must be a file NAME.html, not {path.name!r}")
    return path


def companion(page: Path, name: str) -> Path:
    """Path of the file `name` of the report `page`: reports in one folder do not share files."""
    return page.with_name(name if page.stem == "report" else f"{page.stem}-{name}")


def _write_figures(results: Results, panel: Panel, folder: Path) -> dict[str, bytes]:
    """Write the figures of a panel; returns the SVG files of its charts by name, see `_charts`."""
    name = _file_name(panel)
    for kind, figure in _charts(panel, legend=True).items():
        stem = f"times-{name}" if kind == "times" else f"convergence-{name}-{kind}"
        files.write_bytes(folder / f"{stem}.svg", plots.as_file(figure))
        files.write_bytes(folder / f"{stem}.png", plots.png(figure))
    images = plots.grid(panel, target_file(results.path, panel.task, "png"))
    files.write_bytes(folder / f"images-{name}.png", plots.png(images))
    return {kind: plots.as_file(figure) for kind, figure in _charts(panel, legend=False).items()}


def _charts(panel: Panel, legend: bool) -> dict[str, Figure]:
    """Charts of a panel, by axis and "times"."""
    charts = {axis: plots.convergence(panel, axis, legend) for axis in AXES}
    return {**charts, "times": plots.times(panel, legend)}


def _markdown(results: Results, found: list[Panel], figures: str) -> str:
    """The report in Markdown; figures: name of the folder of its figures."""
    calls = (sentences.command(call).replace("\n", "\n    ") for call in results.calls)
    parts = ["# Comparison", *(f"    {call}" for call in calls)]
    for panel in found:
        name = _file_name(panel)
        curves, images = (
            quote(f"{figures}/{stem}.png", safe="/=+")
            for stem in (f"convergence-{name}-renders", f"images-{name}")
        )
        parts += [
            f"## {tables.escaped(panel.name)}",
            tables.escaped(_summary(panel)),
            tables.markdown(tables.ranking(panel)),
            f"![{tables.escaped(plots.describe(panel))}]({curves})",
            f"![Target, best, median and worst run of each]({images})",
            tables.markdown(tables.times(panel)),
            tables.markdown(tables.losses(panel)),
        ]
    parts += map(tables.escaped, _beside(results))
    parts += ["## How to read it", *sentences.METHOD]
    return "\n\n".join(parts) + "\n"


def _beside(results: Results) -> list[str]:
    """Sentences on what is in no panel."""
    return [*sentences.without_results(results), *sentences.not_shown(results.not_shown)]


def _in_terminal(panel: Panel) -> str:
    """A panel for a terminal."""
    return f"{panel.name}: {_summary(panel)}\n\n{tables.plain(tables.ranking(panel))}"


def _summary(panel: Panel) -> str:
    said = sentences.verdict, sentences.threshold, sentences.failures, sentences.abbreviations
    return " ".join(filter(None, (say(panel) for say in said)))


def _file_name(panel: Panel) -> str:
    return f"{as_file_name(panel.task)}-{as_file_name(panel.loss)}"
