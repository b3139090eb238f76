"""What is known of a run at any time: a code for programs, a sentence for people.

The answer is never that an optimum is global: no black box tells. What can be said is whether the
loss still falls, whether searches from different places ended in the same one, and whether what is
left is within the noise of the renderer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Facts", "Status", "status_of"]


@dataclass(frozen=True, slots=True)
class Status:
    """State of a run.

    code: "waiting", "solved", "noise", "improving", "agreed", "unsure" or "stalled".
    sentence: the same in words, with the numbers.
    """

    code: str
    sentence: str

    def __str__(self) -> str:
        return self.sentence


@dataclass(frozen=True, slots=True)
class Facts:
    """What a status is made of.

    evaluations: so far.
    best: lowest loss so far; None before the first finite one.
    improved_at: evaluation of the last improvement by more than a tenth.
    horizon: evaluations without such an improvement after which a run is no longer improving.
    ended: how many searches ended in each of the distinct places, the best place first.
    noise: standard deviation of the loss of one candidate; None where it was not measured.
    solved: whether the image equals the target to 8 bits: no pixel that counts differs by more than
        1/255, and their mean squared error is at most that of rounding, (1/255)^2 / 12.
    """

    evaluations: int
    best: float | None
    improved_at: int
    horizon: int
    ended: Sequence[int]
    noise: float | None = None
    solved: bool = False


def status_of(facts: Facts) -> Status:
    """Return the first of the states that applies, in the order of `Status.code`."""
    best = facts.best
    if best is None:
        return Status("waiting", "No candidate with a finite loss has been told yet.")
    if facts.solved:
        return Status("solved", f"Solved: the image equals the target to 8 bits, loss {best:.3g}.")
    if facts.noise is not None and facts.noise > 0 and 0 <= best <= 2 * facts.noise:
        return Status(
            "noise",
            f"At the noise floor: loss {best:.3g}, and renders of one candidate differ by "
            f"{facts.noise:.3g}. More samples per pixel would tell more.",
        )
    since = facts.evaluations - facts.improved_at
    if since < facts.horizon:
        return Status("improving", f"Still improving: loss {best:.3g}.")
    return _stalled(best, facts)


def _stalled(best: float, facts: Facts) -> Status:
    stalled = f"No improvement since evaluation {facts.improved_at:,}: loss {best:.3g}."
    if not facts.ended:
        return Status("stalled", stalled)
    same, places, searches = facts.ended[0], len(facts.ended), sum(facts.ended)
    if same >= 3 and 2 * same > searches:
        return Status("agreed", f"{stalled} {same} of {searches} searches ended in this place.")
    if searches == 1:
        return Status("stalled", f"{stalled} One search has ended so far.")
    if places == 1:
        few = f"{same} of {searches} searches ended in this place, too few to be sure."
        return Status("unsure", f"{stalled} {few}")
    return Status(
        "unsure",
        f"{stalled} {searches} searches ended in {places} different places, {same} in the best: "
        "there may be a better one.",
    )
