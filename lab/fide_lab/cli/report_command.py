"""Write the report of a comparison: one page, and a table of all runs.

    fide report runs/first
    fide report runs/first -o comparison.html --threshold mse=0.001 --threshold spline/mse=0.05
    fide report runs/suite -o rivals.html --optimizers fide,cma

The command writes one self-contained page, which needs no network, and results.csv beside it
(comparison-results.csv beside comparison.html).
--optimizers shows some of the optimizers, such as those that have been run on every problem.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from fide_lab.cli.arguments import names, thresholds
from fide_plugins.cli.arguments import path
from fide_plugins.cli.terminal import USAGE_ERRORS, complain, note, plain, warnings_as_notes
from fide_plugins.errors import OptionError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide report``."""
    add = parser.add_argument
    add("directory", type=path, metavar="DIR", help="directory of a comparison")
    add("-o", "--output", type=path, metavar="FILE", help="the page (DIR/report.html)")
    add("--optimizers", type=names, metavar="A,B", help="those that are shown (all)")
    add("--threshold", type=thresholds, action="append", default=[], metavar="[TASK/]LOSS=VALUE",
        help="loss that counts as success; may be repeated "
        "(the second best median of each task and loss)")  # fmt: skip


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    threshold = dict(args.threshold)
    return make(args.directory, args.output, threshold, "fide report", args.optimizers)


def make(
    directory: Path,
    page: Path | None,
    threshold: dict[str, float],
    who: str,
    optimizers: list[str] | None = None,
) -> int:
    """Write the report of `directory`; returns the exit code.

    optimizers: that are shown; None: all.
    """
    from fide_lab.compare.results import AllFailedError

    try:
        from fide_lab import compare, report

        with warnings_as_notes(who):
            results = compare.read(directory)
        if optimizers is not None:
            results = results.of(optimizers)
        for stored in results.runs:
            if stored.state == "damaged":
                note(f"{stored.key} is damaged and left out: {plain(stored.why)}")
        path = page or directory / "report.html"
        if "suite" in results.settings["task_options"]:
            from fide_lab.suite import page as suite_page

            if threshold:
                raise OptionError("a suite has its own thresholds; leave --threshold out")
            written = suite_page.write(results, path)
        else:
            written = report.write(results, path, threshold)
    except AllFailedError as error:
        note(f"{who}: {plain(error)}")
        return 1
    except USAGE_ERRORS as error:
        return complain(who, error)
    print(written.overview)
    print(f"look at {plain(written.page)}")
    return 0
