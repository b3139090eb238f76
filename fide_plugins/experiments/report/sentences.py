"""The results of a panel in sentences, for the page, Markdown and a terminal; and the method."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from typing import Any

from fide_plugins.experiments.report.panel import SIGNIFICANT, Panel
from fide_plugins.experiments.report.tables import number

__all__ = ["METHOD", "abbreviations", "command", "threshold", "verdict"]

METHOD = (
    "All optimizers have the same target, the same box and, unless the table says otherwise, the "
    "same number of renders. A search starts at or around the center of the box; random search "
    "draws uniformly from the whole box. Runs with the same seed form a pair.",
    "The loss of a run is the loss of its best candidate, rendered without noise. The curves show "
    "the lowest loss so far that the optimizer received.",
    "Lines and bands are medians and quantiles (25 to 75 %, 5 to 95 %) over seeds. A run that "
    "never had a finite loss counts as infinite.",
    "A run succeeds if its noise-free final loss is at most the threshold. The success rate has "
    "Wilson's 95 % interval. Renders to the threshold are a median in which a run that does not "
    "succeed counts as infinite.",
    "The winner has the lowest median. A two-sided Wilcoxon signed-rank test compares each rival "
    "with the winner, pair by pair. It uses logarithms of the losses, or the losses if one of them "
    "is 0; if budgets differ, it uses the curves at the end of the smaller budget. The p shown are "
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
    text = f"{winner.name} has the lowest median, {number(winner.median)}."
    if not tests:
        return text
    pairs = max(test.n for test in tests.values())
    smallest = max(test.smallest_p for test in tests.values() if test.n == pairs)
    if smallest >= SIGNIFICANT:
        return (
            f"{text} With {pairs} pair{'s' * (pairs > 1)} no difference can be significant: "
            f"p cannot be below {smallest:.2g}; use at least 6 seeds."
        )
    rivals = [row for row in panel.rows if row.label in tests]
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


def threshold(panel: Panel) -> str:
    """The loss that counts as success, and its origin."""
    value = f"Success is {panel.loss} of {number(panel.threshold)} or less"
    return f"{value}." if panel.stated else f"{value}, the second best median."


def abbreviations(panel: Panel) -> str:
    """Full labels of the configurations whose names are shortened; empty if there are none."""
    full = [f"{row.name} is {row.label}" for row in panel.rows if row.name != row.label]
    return f"Here {_list(full)}." if full else ""


def _list(names: Iterable[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
