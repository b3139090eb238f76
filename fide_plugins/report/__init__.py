"""The report of a comparison: one page, tables, figures.

    from fide_plugins import compare, report
    report.write(compare.read("runs/first"), "runs/first/report.html")

`statistics` knows curves and numbers, `panel` what can be said of one task and loss, `tables`,
`plots`, `pictures` and `words` show a panel, `page` puts sections into one HTML file; none of the
last five knows of directories, so that other pages can be made of them.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from fide_plugins import files
from fide_plugins.compare.arms import as_file_name
from fide_plugins.compare.results import AXES, NoResultsError, Results
from fide_plugins.compare.study import target_file
from fide_plugins.errors import OptionError
from fide_plugins.report import export, pictures, plots, svg, tables, words
from fide_plugins.report.panel import Panel, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Written", "write"]


@dataclass(frozen=True)
class Written:
    """What was written; overview: the table of every panel, for a terminal."""

    page: Path
    overview: str


def write(
    results: Results,
    page: str | os.PathLike[str],
    thresholds: dict[str, float] | None = None,
) -> Written:
    """Write the page, and beside it report.md, results.csv, curves.csv and figures/.

    page: report.html; beside one of another name, their names begin with it: a.md, a-results.csv.
    thresholds: by "task/loss" or "loss", the loss that counts as success; the second best median
        of a panel by default.

    Raises NoResultsError (a FileNotFoundError) if no run is finished, OptionError (a ValueError)
    for a page that is no .html or a threshold of nothing that was compared, DependencyError (an
    ImportError) without Jinja2, OSError if a file cannot be written.
    """
    from fide_plugins.report import page as page_module

    path = Path(page)
    if path.suffix.lower() not in (".html", ".htm"):
        raise OptionError(f"the page is a file NAME.html, not {path.name!r}")
    _check(results, thresholds or {})
    found = panels(results, thresholds or {})
    if not found:
        raise NoResultsError(f"no run in {results.path} is finished; run: fide compare --resume")
    page_module.environment()  # before anything is written
    figures = _beside(path, "figures")
    figures.mkdir(parents=True, exist_ok=True)
    charts = [_write_figures(results, panel, figures) for panel in found]
    files.write_text(_beside(path, "results.csv"), export.results_csv(results))
    files.write_text(_beside(path, "curves.csv"), export.curves_csv(results))
    files.write_text(path.with_suffix(".md"), _markdown(results, found, figures.name))
    files.write_text(path, page_module.render(results, found, charts))
    return Written(path, "\n\n".join(_section(panel) for panel in found) + "\n")


def _beside(page: Path, name: str) -> Path:
    """Where a file beside the page lies, so that reports in one folder do not mix."""
    return page.with_name(name if page.stem == "report" else f"{page.stem}-{name}")


def _check(results: Results, thresholds: dict[str, float]) -> None:
    cells = [result.cell for result in results.cells]
    known = {c.loss for c in cells} | {f"{c.task}/{c.loss}" for c in cells}
    unknown = sorted(set(thresholds) - known)
    if unknown:
        raise OptionError(
            f"a threshold of {unknown[0]!r}, which was not compared; there are "
            f"{', '.join(sorted(known))}"
        )


def _write_figures(results: Results, panel: Panel, folder: Path) -> dict[str, bytes]:
    """Write the figures of a panel; returns SVG of its charts for the page, as `_charts`."""
    name = _file_name(panel)
    for kind, figure in _charts(panel, legend=True).items():
        stem = f"times-{name}" if kind == "times" else f"convergence-{name}-{kind}"
        files.write_bytes(folder / f"{stem}.svg", svg.as_file(figure))
        files.write_bytes(folder / f"{stem}.png", svg.png(figure))
    images = pictures.grid(panel, target_file(results.path, panel.task))
    files.write_bytes(folder / f"images-{name}.png", svg.png(images))
    return {kind: svg.as_file(figure) for kind, figure in _charts(panel, legend=False).items()}


def _charts(panel: Panel, legend: bool) -> dict[str, Figure]:
    """Charts of a panel, by axis and "times"."""
    charts = {axis: plots.convergence(panel, axis, legend) for axis in AXES}
    return {**charts, "times": plots.times(panel, legend)}


def _markdown(results: Results, found: list[Panel], figures: str) -> str:
    """The report in Markdown; figures: the folder of its pictures."""
    calls = (words.command(call).replace("\n", "\n    ") for call in results.calls)
    parts = ["# Comparison", *(f"    {call}" for call in calls)]
    for panel in found:
        name = _file_name(panel)
        curves, images = (
            quote(f"{figures}/{stem}.png", safe="/=+")
            for stem in (f"convergence-{name}-renders", f"images-{name}")
        )
        parts += [
            f"## {tables.escaped(panel.name)}",
            tables.escaped(_said(panel)),
            tables.markdown(tables.ranking(panel)),
            f"![{tables.escaped(plots.describe(panel))}]({curves})",
            f"![Target, best, median and worst run of each]({images})",
            tables.markdown(tables.times(panel)),
            tables.markdown(tables.losses(panel)),
        ]
    parts += ["## How to read it", *words.METHOD]
    return "\n\n".join(parts) + "\n"


def _section(panel: Panel) -> str:
    """A panel for a terminal."""
    return f"{panel.name}: {_said(panel)}\n\n{tables.markdown(tables.ranking(panel))}"


def _said(panel: Panel) -> str:
    sentences = words.verdict(panel), words.threshold(panel), words.abbreviations(panel)
    return " ".join(filter(None, sentences))


def _file_name(panel: Panel) -> str:
    return f"{as_file_name(panel.task)}-{as_file_name(panel.loss)}"
