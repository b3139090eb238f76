"""The results of a panel in sentences, for the page, Markdown and a terminal; and the method."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Sequence
from typing import Any

from fide_lab.compare.results import Results
from fide_lab.report.panel import SIGNIFICANT, Panel
from fide_lab.report.tables import number
from fide_plugins.runtime.messages import counted

METHOD = (
    "All optimizers have the same target, the same box and, unless the table says otherwise, the "
    "same number of renders. A search starts at or around the center of the box; random search "
    "draws uniformly from the whole box. Runs with the same seed form a pair.",
    "The loss of a run is the loss of its best candidate, rendered without noise where the task "
    "can do that. A renderer of your own cannot: its loss is that of the best image as it was "
    "seen. If it is noisy, the more renders, the lower is that loss by luck.",
    "Lines and bands are medians and quantiles (25 to 75 %, 5 to 95 %) over seeds. A run that "
    "failed, or never had a finite loss, counts as infinite: no optimizer gains by failing. "
    "Missing and unfinished runs are left out.",
    "Renders to it are a median, to the threshold; a run that does not succeed counts as infinite.",
    "The winner has the lowest median. A two-sided Wilcoxon signed-rank test compares each rival "
    "with the winner, pair by pair, by logarithms of the losses. Pairs without a difference have "
    "ranks, too (Pratt). If budgets differ, it uses the curves at the end of the smaller budget. "
    "p is adjusted for all rivals (Benjamini and Hochberg); † marks p below "
    f"{SIGNIFICANT}. The same numbers choose the winner, so a p near that limit is weak evidence.",
    "Seconds are the wall time of one run in one process. They include saving its state (at most a "
    "twentieth), but not measuring other losses.",
)


def command(call: dict[str, Any]) -> str:
    """The command line of a call."""
    return shlex.join(call["command"]) or "called from Python"


def summary(panel: Panel) -> str:
    """All that is said of a panel."""
    success = f"Success is any finite {panel.loss}."
    if math.isfinite(panel.threshold):
        origin = "" if panel.stated else ", the second best median"
        success = f"Success is {panel.loss} of {number(panel.threshold)} or less{origin}."
    full = [f"{row.name} is {row.label}" for row in panel.every if row.name != row.label]
    short = f"Here {_list(full)}." if full else ""
    return " ".join(filter(None, (_verdict(panel), success, _failures(panel), short)))


def _verdict(panel: Panel) -> str:
    """The winner, and which differences to it are significant."""
    winner, tests = panel.winner, panel.against_winner
    if winner is None:
        return "No optimizer has a finite median."
    has = "share" if len(panel.lowest) > 1 else "has"
    names = _list(row.name for row in panel.lowest)
    text = f"{names} {has} the lowest median, {number(winner.median)}."
    rivals = [row for row in panel.every if row.label in tests and row not in panel.lowest]
    if not rivals:
        return text
    most = max((tests[row.label] for row in rivals), key=lambda test: test.n)
    if most.smallest_p >= SIGNIFICANT:
        return (
            f"{text} With {counted(most.n, 'pair')} no difference can be significant: "
            f"p cannot be below {most.smallest_p:.2g}; use at least 6 seeds."
        )
    beaten = [row.name for row in rivals if panel.significant(row)]
    level = [row.name for row in rivals if not panel.significant(row)]
    if beaten:
        text += f" {winner.name} is significantly better than {_list(beaten)}."
    if level:
        text += f" The difference to {_list(level)} may be chance."
    return text


def _failures(panel: Panel) -> str:
    """How many runs of which configuration failed; empty if none did."""
    rows = [row for row in panel.every if row.failed]
    if not rows:
        return ""
    failed, planned = sum(len(row.failed) for row in rows), sum(r.planned for r in panel.every)
    each = ", ".join(f"{row.name} {len(row.failed)} of {row.planned}" for row in rows)
    return f"{failed} of {planned} runs failed and count as infinite: {each}."


def without_results(results: Results) -> list[str]:
    """A sentence for each task and loss without a finished run, which have no panel."""
    groups: dict[str, list[str]] = {}
    for run in results.runs:
        groups.setdefault(f"{run.key.task}, {run.key.loss}", []).append(run.state)
    return [
        f"{name}: no run is finished, {states.count('failed')} of {len(states)} failed."
        for name, states in groups.items()
        if "finished" not in states
    ]


def not_shown(labels: Sequence[str]) -> list[str]:
    """A sentence on the optimizers of a comparison that its page leaves out, if there are some."""
    return [f"Not shown: {_list(labels)}."] if labels else []


def _list(names: Iterable[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
