"""Write the report of a comparison: one page, tables and figures.

    fide report runs/first
    fide report runs/first -o comparison.html --threshold mse=0.001 --threshold spline/mse=0.05

The command writes one self-contained page, which needs no network. The same folder gets report.md,
results.csv, curves.csv and figures/ (PNG and SVG). If the page is called comparison.html, the files
are comparison.md, comparison-results.csv, and so on.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from fide_plugins.cli.arguments import thresholds
from fide_plugins.cli.messages import complain, note, plain

__all__ = ["add_arguments", "execute", "make"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide report``."""
    add = parser.add_argument
    add("directory", type=Path, metavar="DIR", help="directory of a comparison")
    add("-o", "--output", type=Path, metavar="FILE", help="the page (DIR/report.html)")
    add("--threshold", type=thresholds, action="append", default=[], metavar="[TASK/]LOSS=VALUE",
        help="loss that counts as success; may be repeated "
        "(the second best median of each task and loss)")  # fmt: skip


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    return make(args.directory, args.output, dict(args.threshold), "fide report")


def make(directory: Path, page: Path | None, threshold: dict[str, float], who: str) -> int:
    """Write the report of `directory`; returns the exit code."""
    from fide_plugins.cli.running import USAGE_ERRORS

    try:
        from fide_plugins.experiments import compare, report

        results = compare.read(directory)
        for stored in results.runs:
            if stored.status == "damaged":
                note(f"{stored.key} is damaged and left out: {plain(stored.why)}")
        written = report.write(results, page or directory / "report.html", threshold)
    except USAGE_ERRORS as error:
        return complain(who, error)
    print(written.overview)
    print(f"look at {plain(written.page)}")
    return 0
