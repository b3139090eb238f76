"""What the page of a suite says of failed runs, and of what is left out."""

from __future__ import annotations

from collections.abc import Iterable

from fide_lab.report import sentences
from fide_lab.suite.scores import Scores
from fide_plugins.runtime.messages import counted

__all__ = ["remarks"]

_SHOWN = 5
"""Most problems that are named for one optimizer."""


def remarks(found: Scores) -> list[str]:
    """Sentences on failed runs, on problems and on optimizers that are left out, if there are."""
    said = sentences.not_shown(found.not_shown)
    if found.failed:
        problems = counted(len({problem for _, problem in found.failed}), "problem")
        runs = _listed((label, problem, "failed") for label, problem in found.failed)
        said.append(f"Failed runs count as unsolved, {problems}: {runs}.")
    if found.left_out:
        problems = counted(len({problem for _, problem, _ in found.left_out}), "problem")
        runs = _listed(found.left_out)
        said.append(f"Left out, {problems}: {runs}.")
    if any(status == "not planned" for _, _, status in found.left_out):
        said.append(
            "fide compare --resume adds runs, fide report --optimizers A,B shows only these "
            "optimizers."
        )
    return said


def _listed(runs: Iterable[tuple[str, str, str]]) -> str:
    """Problems by optimizer and status, the first few by name; optimizers with the same at once.

    runs: optimizer, problem and status of each.
    """
    of: dict[tuple[str, str], list[str]] = {}
    for label, problem, status in runs:
        of.setdefault((label, status), []).append(problem)
    groups: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for (label, status), its in of.items():
        groups.setdefault((status, tuple(its)), []).append(label)
    parts = []
    for (status, problems), labels in groups.items():
        more = f" and {len(problems) - _SHOWN} more" if len(problems) > _SHOWN else ""
        verb = _verb(status, len(labels) > 1)
        parts.append(f"{', '.join(labels)} {verb} on {', '.join(problems[:_SHOWN])}{more}")
    return "; ".join(parts)


def _verb(status: str, several: bool) -> str:
    if status == "failed":
        return "failed"
    if status == "not planned":
        return "were not run" if several else "was not run"
    return f"{'are' if several else 'is'} {status}"
