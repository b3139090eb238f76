"""The report of a comparison: one page, tables, figures.

    from fide_lab import compare
    from fide_lab import report
    report.write(compare.read("runs/first"), "runs/first/report.html")

=============  ====================================================================
`statistics`   quantiles, bands, paired tests and success rates
`panel`        the results for one task and one loss
`tables`       tables of a panel, for HTML, Markdown and a terminal
`plots`        charts of a panel, as matplotlib figures
`pictures`     images that the runs of a panel found
`sentences`    the results of a panel in sentences, and the method
`labels`       short names of configurations
`svg`          figures as SVG and PNG files, and as SVG elements of a page
`page`         one HTML file, made from `templates/`
`export`       results.csv and curves.csv
=============  ====================================================================
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from fide_lab.compare.plan import as_file_name, target_file
from fide_lab.compare.results import (
    AXES,
    AllFailedError,
    NoResultsError,
    Results,
)
from fide_lab.report import export, pictures, plots, sentences, svg, tables
from fide_lab.report.panel import Panel, check_thresholds, panels
from fide_plugins.errors import OptionError
from fide_plugins.runtime import files

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Written", "write"]


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
    from fide_lab.report import page as page_module

    path = page_path(page)
    check_thresholds(thresholds or {}, [run.key for run in results.runs])
    found = panels(results, thresholds or {})
    AllFailedError.check(results)
    if not found:
        raise NoResultsError(f"no run in {results.path} is finished; run: fide compare --resume")
    page_module.environment()  # raises without Jinja2, before anything is written
    figures = companion(path, "figures")
    figures.mkdir(parents=True, exist_ok=True)
    charts = [_write_figures(results, panel, figures) for panel in found]
    files.write_text(companion(path, "results.csv"), export.results_csv(results))
    files.write_text(companion(path, "curves.csv"), export.curves_csv(results))
    files.write_text(path.with_suffix(".md"), _markdown(results, found, figures.name))
    files.write_text(path, page_module.render(results, found, charts))
    parts = [*map(_section, found), *_beside(results)]
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
        files.write_bytes(folder / f"{stem}.svg", svg.as_file(figure))
        files.write_bytes(folder / f"{stem}.png", svg.png(figure))
    images = pictures.grid(panel, target_file(results.path, panel.task, "png"))
    files.write_bytes(folder / f"images-{name}.png", svg.png(images))
    return {kind: svg.as_file(figure) for kind, figure in _charts(panel, legend=False).items()}


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


def _section(panel: Panel) -> str:
    """A panel for a terminal."""
    return f"{panel.name}: {_summary(panel)}\n\n{tables.plain(tables.ranking(panel))}"


def _summary(panel: Panel) -> str:
    said = sentences.verdict, sentences.threshold, sentences.failures, sentences.abbreviations
    return " ".join(filter(None, (say(panel) for say in said)))


def _file_name(panel: Panel) -> str:
    return f"{as_file_name(panel.task)}-{as_file_name(panel.loss)}"
