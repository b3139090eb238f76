"""One self-contained HTML page with its style, script, charts and pictures.

Jinja2 escapes all text from files and names.  The only markup that passes unescaped is the SVG of
our own figures, whose text matplotlib has escaped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np

from fide_lab.compare.plan import target_file
from fide_lab.compare.results import AXES, Results, StoredRun
from fide_lab.report import pictures, plots, sentences, svg, tables
from fide_lab.report.panel import Panel
from fide_plugins.runtime.machine import missing

__all__ = ["environment", "render"]


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
    marks, strips = pictures.film(panel)
    return {
        "panel": panel,
        "anchor": f"panel-{number}",
        "verdict": sentences.verdict(panel),
        "failures": sentences.failures(panel),
        "threshold": sentences.threshold(panel),
        "abbreviations": sentences.abbreviations(panel),
        "shorter": len({row.budget for row in panel.rows}) > 1,
        "charts": [_chart(panel, axis, charts[axis], f"p{number}-{axis}") for axis in AXES],
        "times": svg.markup(charts["times"], f"p{number}-times", plots.describe_times(panel)),
        "ranking": tables.ranking(panel),
        "time_table": tables.times(panel),
        "losses": tables.losses(panel),
        "target": pictures.picture(
            target_file(results.path, panel.task, "png"), f"target of {panel.task}", "target"
        ),
        "found": pictures.rows_of(panel),
        "marks": marks,
        "film": strips,
    }


def _chart(panel: Panel, axis: str, file: bytes, name: str) -> Chart:
    title = plots.AXIS_NAMES[axis]
    description = f"{plots.describe(panel)} Along: {title}."
    return Chart(axis, title, svg.markup(file, name, description))


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
