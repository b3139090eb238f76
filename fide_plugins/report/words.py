"""What a panel says, in sentences: for the page, for Markdown, and for a terminal."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from typing import Any

from fide_plugins.report.panel import SIGNIFICANT, Panel
from fide_plugins.report.tables import number

__all__ = ["METHOD", "abbreviations", "command", "threshold", "verdict"]

METHOD = (
    "Everyone has the same target, the same number of renders unless another is said, and the same "
    "box, at whose center or around it a search begins; who draws uniformly does so in all of it. "
    "Runs of one seed are a pair.",
    "The loss of a run is that of what it found, judged on a render without noise; the curves show "
    "the lowest loss so far as the optimizer was told it.",
    "Middle and bands are medians and quantiles (25 to 75 %, 5 to 95 %) over seeds. A run whose "
    "losses never were finite counts as infinite.",
    "Success is a run that found something at or below the threshold, judged without noise; its "
    "rate has Wilson's 95 % interval. Renders to the threshold are a median in which a run that "
    "never got there counts as infinite.",
    "The winner has the lowest median. Each rival is compared with it by a two-sided Wilcoxon "
    "signed-rank test of the logarithms of the losses (of the losses, where one is 0), pair by "
    "pair; where budgets differ, of what the curves show at the end of the smaller one. The p "
    "shown are adjusted for all rivals of a panel (Benjamini and Hochberg); † marks those below "
    f"{SIGNIFICANT}. The winner was chosen by the same numbers, so that a p near the limit says "
    "little. The effect is the matched-pairs rank-biserial correlation.",
    "Seconds are wall time of one run in one process, with the saving of its state (a twentieth at "
    "most); measuring other losses and taking pictures is not part of it. What ran beside is said "
    "under Origin.",
    "Rounds of 8 parallel renders are counted from the record of what each optimizer asked for at "
    "once: n candidates take n / 8 rounds, rounded up, and the next generation begins when all are "
    "back. The optimizer's own time is not part of it.",
)


def command(call: dict[str, Any]) -> str:
    """The command line of a call."""
    return shlex.join(call["command"]) or "called from Python"


def verdict(panel: Panel) -> str:
    """Who won, over whom, and how surely."""
    winner, tests = panel.winner, panel.against_winner
    said = f"{winner.name} has the lowest median, {number(winner.median)}."
    if not tests:
        return said
    pairs = max(test.n for test in tests.values())
    smallest = max(test.smallest_p for test in tests.values() if test.n == pairs)
    if smallest >= SIGNIFICANT:
        return (
            f"{said} With {pairs} pair{'s' * (pairs > 1)} no difference can be called significant: "
            f"p cannot be below {smallest:.2g}; at least 6 seeds are needed."
        )
    rivals = [row for row in panel.rows if row.arm in tests]
    beaten = [row.name for row in rivals if panel.significant(row)]
    level = [row for row in rivals if not panel.significant(row)]
    always = [row.name for row in level if tests[row.arm].effect == 1.0]
    chance = [row.name for row in level if tests[row.arm].effect != 1.0]
    if beaten:
        said += f" It is better by more than chance than {_list(beaten)}."
    if always:
        said += (
            f" It is better in every pair than {_list(always)}, but with {len(tests)} rivals these "
            "pairs are too few to rule out chance; more seeds would tell."
        )
    if chance:
        said += f" The difference to {_list(chance)} may be chance."
    return said


def threshold(panel: Panel) -> str:
    """What counts as success, and why."""
    value = f"Success is {panel.loss} of {number(panel.threshold)} or less"
    return f"{value}." if panel.stated else f"{value}, the second best median."


def abbreviations(panel: Panel) -> str:
    """Which options the names of optimizers leave out; empty if none."""
    said = [f"{row.name} is {row.arm}" for row in panel.rows if row.name != row.arm]
    return f"Here {_list(said)}." if said else ""


def _list(names: Iterable[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
