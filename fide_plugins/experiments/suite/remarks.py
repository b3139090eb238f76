"""What the page of a suite says of runs that failed, and of problems that are left out."""

from __future__ import annotations

from collections.abc import Iterable

from fide_plugins.experiments.suite.scores import Scores

__all__ = ["remarks"]

_SHOWN = 5
"""Most problems that are named for one optimizer."""


def remarks(found: Scores) -> list[str]:
    """A sentence each for failed runs and for problems that are left out, where there are some."""
    said = []
    if found.failed:
        problems = _counted({problem for _, problem in found.failed})
        runs = ((f"{label} failed on", problem) for label, problem in found.failed)
        said.append(f"Failed runs count as unsolved, {problems}: {_listed(runs)}.")
    if found.left_out:
        problems = _counted({run.key.task for run in found.left_out})
        open_ = ((f"{r.key.configuration} is {r.status} on", r.key.task) for r in found.left_out)
        said.append(f"Left out, {problems}: {_listed(open_)}.")
    return said


def _counted(problems: set[str]) -> str:
    return f"{len(problems)} problem{'s' * (len(problems) > 1)}"


def _listed(runs: Iterable[tuple[str, str]]) -> str:
    """Problems by what is said of them, the first few by name."""
    groups: dict[str, list[str]] = {}
    for said, problem in runs:
        groups.setdefault(said, []).append(problem)
    parts = []
    for said, names in groups.items():
        more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        parts.append(f"{said} {', '.join(names[:_SHOWN])}{more}")
    return "; ".join(parts)
