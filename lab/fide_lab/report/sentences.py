"""The results of a panel in sentences, for the page, Markdown and a terminal; and the method."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Sequence
from typing import Any

from fide_lab.compare.results import Results, StoredRun
from fide_lab.report.panel import SIGNIFICANT, Panel, Row
from fide_lab.report.tables import number
from fide_plugins.runtime.messages import counted

__all__ = [
    "METHOD",
    "abbreviations",
    "command",
    "failures",
    "not_shown",
    "threshold",
    "verdict",
    "without_results",
]

_ENOUGH = 6
"""Least number of pairs that can show a significant difference."""

METHOD = (
    "All optimizers have the same target, the same box and, unless the table says otherwise, the "
    "same number of renders. A search starts at or around the center of the box; random search "
    "draws uniformly from the whole box. Runs with the same seed form a pair.",
    "The loss of a run is the loss of its best candidate, rendered without noise where the task "
    "can do that. A renderer of your own cannot: its loss is that of the best image as it was "
    "seen. If it is noisy, the more renders, the lower is that loss by luck. The curves show the "
    "lowest loss so far that the optimizer received.",
    "Lines and bands are medians and quantiles (25 to 75 %, 5 to 95 %) over seeds. A run that "
    "failed, or never had a finite loss, counts as infinite: no optimizer gains by failing. "
    "Missing and unfinished runs are left out. Pictures and times are of finished runs.",
    "A run succeeds if the loss of the run is at most the threshold. The success rate has Wilson's "
    "95 % interval. Renders to the threshold are a median in which a run that does not "
    "succeed counts as infinite.",
    "The winner has the lowest median. A two-sided Wilcoxon signed-rank test compares each rival "
    "with the winner, pair by pair. It uses logarithms of the losses, or the losses if one of them "
    "is negative; a loss of 0 is better than any other by more than any other difference. If "
    "budgets differ, it uses the curves at the end of the smaller budget. Pairs without a "
    "difference have ranks, too (Pratt). With ties it is exact for up to 12 pairs. The p shown are "
    "adjusted for all rivals of a panel (Benjamini and Hochberg); † marks p below "
    f"{SIGNIFICANT}. The same numbers choose the winner, so a p near that limit is weak evidence. "
    "The effect is the matched-pairs rank-biserial correlation.",
    "Seconds are the wall time of one run in one process. They include saving its state (at most a "
    "twentieth), but not measuring other losses and writing pictures. Origin lists the processes "
    "that ran at the same time.",
    "Rounds of 8 parallel renders are computed from the sizes of the generations: n candidates "
    "take n / 8 rounds, rounded up, and the next generation starts when all are evaluated. They "
    "do not include the time of the optimizer itself.",
)


def command(call: dict[str, Any]) -> str:
    """The command line of a call."""
    return shlex.join(call["command"]) or "called from Python"


def verdict(panel: Panel) -> str:
    """The winner, and which differences to it are significant."""
    winner, tests = panel.winner, panel.against_winner
    if winner is None:
        return "No optimizer has a finite median."
    rivals = [row for row in panel.every if row.label in tests and row not in panel.lowest]
    shared = len(panel.lowest) > 1
    has = "share" if shared else "has"
    text = f"{_list(row.name for row in panel.lowest)} {has} the lowest median, "
    text += f"{number(winner.median)}."
    if not rivals:
        return text
    if shared:
        text += f" The others are compared with {winner.name}."
    most = max((tests[row.label] for row in rivals), key=lambda test: test.n)
    if most.smallest_p >= SIGNIFICANT:
        return (
            f"{text} With {counted(most.n, 'pair')} no difference can be significant: "
            f"p cannot be below {most.smallest_p:.2g}; {_more_pairs(panel)}."
        )
    return text + _differences(panel, rivals)


def _more_pairs(panel: Panel) -> str:
    """How to come to enough pairs."""
    planned = sum(row.planned for row in panel.every)
    open_ = planned - sum(len(row.finals) for row in panel.every)
    if open_ and min(row.planned for row in panel.every) >= _ENOUGH:
        return f"{open_} of {planned} runs are not finished, continue with --resume"
    return f"use at least {_ENOUGH} seeds"


def _differences(panel: Panel, rivals: Sequence[Row]) -> str:
    """Which differences between the winner and its rivals are significant."""
    tests, text = panel.against_winner, ""
    beaten = [row.name for row in rivals if panel.significant(row)]
    level = [row for row in rivals if not panel.significant(row)]
    always = [row.name for row in level if tests[row.label].effect == 1.0]
    chance = [row.name for row in level if tests[row.label].effect != 1.0]
    if beaten:
        text += f" It is significantly better than {_list(beaten)}."
    if always:
        text += (
            f" It is better in every pair than {_list(always)}, but with {len(tests)} rivals there "
            "are too few pairs to rule out chance; use more seeds."
        )
    if chance:
        text += f" The difference to {_list(chance)} may be chance."
    return text


def failures(panel: Panel) -> str:
    """How many runs of which configuration failed; empty if none did."""
    rows = [row for row in panel.every if row.failed]
    if not rows:
        return ""
    failed, planned = sum(len(row.failed) for row in rows), sum(r.planned for r in panel.every)
    each = ", ".join(f"{row.name} {len(row.failed)} of {row.planned}" for row in rows)
    return f"{failed} of {planned} runs failed and count as infinite: {each}."


def without_results(results: Results) -> list[str]:
    """A sentence for each task and loss without a finished run, which have no panel."""
    groups: dict[str, list[StoredRun]] = {}
    for run in results.runs:
        groups.setdefault(f"{run.key.task}, {run.key.loss}", []).append(run)
    said = []
    for name, runs in groups.items():
        if not any(run.state == "finished" for run in runs):
            failed = sum(run.state == "failed" for run in runs)
            said.append(f"{name}: no run is finished, {failed} of {len(runs)} failed.")
    return said


def not_shown(labels: Sequence[str]) -> list[str]:
    """A sentence on the optimizers of a comparison that its page leaves out, if there are some."""
    return [f"Not shown: {_list(labels)}."] if labels else []


def threshold(panel: Panel) -> str:
    """The loss that counts as success, and its origin."""
    second = sum(bool(row.finals) for row in panel.every) > 1
    if not math.isfinite(panel.threshold):
        why = "no second median is" if second else "the only median is not"
        return f"Success is any finite {panel.loss}, since {why} finite."
    value = f"Success is {panel.loss} of {number(panel.threshold)} or less"
    which = "second best" if second else "only"
    return f"{value}." if panel.stated else f"{value}, the {which} median."


def abbreviations(panel: Panel) -> str:
    """Full labels of the configurations whose names are shortened; empty if there are none."""
    full = [f"{row.name} is {row.label}" for row in panel.every if row.name != row.label]
    return f"Here {_list(full)}." if full else ""


def _list(names: Iterable[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
