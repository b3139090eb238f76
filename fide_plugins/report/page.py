"""One self-contained HTML page: style, script, charts and pictures are all inside.

Whatever comes from files or names is escaped by Jinja2; the only markup that is let through is the
SVG of our own figures, whose text matplotlib has escaped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np

from fide_plugins.compare.results import AXES, CellResult, Results
from fide_plugins.compare.study import target_file
from fide_plugins.errors import DependencyError
from fide_plugins.report import pictures, plots, svg, tables, words
from fide_plugins.report.panel import Panel

__all__ = ["environment", "render"]


@dataclass(frozen=True)
class Chart:
    """A chart along one of several axes: its name, its title, and the SVG element."""

    axis: str
    title: str
    svg: Any


def render(results: Results, panels: Sequence[Panel], charts: Sequence[dict[str, bytes]]) -> str:
    """The page of a comparison.

    charts: of each panel, SVG files: by axis, its convergence; and "times".
    """
    env = environment()
    sections = [
        _section(results, panel, files, i)
        for i, (panel, files) in enumerate(zip(panels, charts, strict=True))
    ]
    settings = results.settings
    tasks = ", ".join(dict.fromkeys(panel.task for panel in panels))
    html: str = env.get_template("comparison.html").render(
        title=f"Comparison: {tasks}",
        sections=sections,
        settings=settings,
        seeds=len({result.cell.seed for result in results.cells}),
        optimizers=len({result.cell.arm for result in results.cells}),
        cells=len(results.cells),
        renders=_renders(panels),
        troubles=[r for r in results.cells if r.curve is None],
        calls=[_call(call) for call in results.calls],
        versions=results.versions,
        machine=results.machine,
        load=_load(results.cells),
        method=words.METHOD,
    )
    return html


def environment() -> Any:
    """Templates of this package, with everything escaped, and what all pages have.

    Raises DependencyError (an ImportError) if Jinja2 is not installed.
    """
    try:
        import jinja2
    except ImportError as error:
        raise DependencyError(
            "a report needs Jinja2: pip install 'fide-plugins[report]'"
        ) from error
    from markupsafe import Markup

    folder = resources.files("fide_plugins.report") / "templates"
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
    marks, strips = pictures.film(panel)
    return {
        "panel": panel,
        "anchor": f"panel-{number}",
        "verdict": words.verdict(panel),
        "threshold": words.threshold(panel),
        "abbreviations": words.abbreviations(panel),
        "shorter": len({row.budget for row in panel.rows}) > 1,
        "charts": [_chart(panel, axis, charts[axis], f"p{number}-{axis}") for axis in AXES],
        "times": _markup(charts["times"], f"p{number}-times", plots.describe_times(panel)),
        "ranking": tables.ranking(panel),
        "time_table": tables.times(panel),
        "losses": tables.losses(panel),
        "target": pictures.picture(
            target_file(results.path, panel.task), f"target of {panel.task}", "target"
        ),
        "found": pictures.rows_of(panel),
        "marks": marks,
        "film": strips,
    }


def _chart(panel: Panel, axis: str, file: bytes, name: str) -> Chart:
    title = plots.AXIS_NAMES[axis]
    description = f"{plots.describe(panel)} Along: {title}."
    return Chart(axis, title, _markup(file, name, description))


def _markup(file: bytes, name: str, description: str) -> Any:
    from markupsafe import Markup

    return Markup(svg.in_page(file, name, description))


def _call(call: dict[str, Any]) -> dict[str, Any]:
    """A call of the command, with what ran at the same time in words."""
    where = "on a Dask cluster" if call.get("dask") else f"{call.get('jobs', 1)} processes"
    where = "one process" if where == "1 processes" else where
    where = f"{where}, {call.get('cores')} cores"
    return {**call, "command": words.command(call), "where": where}


def _renders(panels: Sequence[Panel]) -> str:
    """Renders of a run, or of the shortest and the longest."""
    budgets = sorted({row.budget for panel in panels for row in panel.rows})
    return " to ".join(map(tables.number, dict.fromkeys((budgets[0], budgets[-1]))))


def _load(cells: Sequence[CellResult]) -> dict[str, float] | None:
    """Load average of the machine at the end of each run: the median, and the highest."""
    said = (result.run.get("load") for result in cells if result.curve is not None)
    loads = [load for load in said if isinstance(load, int | float)]
    return {"median": float(np.median(loads)), "highest": max(loads)} if loads else None
