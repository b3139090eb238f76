"""What is known of a run at any time: a code for programs, a sentence for people.

No black box tells that an optimum is global, and no sentence claims it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE

_STALLED = 20  # generations without improvement; or a quarter of all evaluations, if that is more
_NEARLY_ALL = 0.9  # of the images
_NEXT = "fit again with another seed and compare the losses, or give more renders"


@dataclass(frozen=True, slots=True)
class Status:
    """State of a run.

    code: "waiting", "solved", "noise", "improving", "mismatch", "agreed", "unsure" or
        "stalled".
    sentence: the same in words, with the numbers.
    """

    code: str
    sentence: str

    def __str__(self) -> str:
        return self.sentence

    def to_dict(self) -> dict[str, str]:
        """As files have it: the code is named "status"."""
        return {"status": self.code, "sentence": self.sentence}


@dataclass(frozen=True, slots=True)
class Facts:
    """What a status is made of.

    best: lowest loss so far; None before the first finite one.
    improved_at: evaluation of the last improvement by more than a tenth; horizon: evaluations
        without one after which a run is no longer improving.
    ended: how many searches ended in each of the distinct places, the best place first; only those
        that had begun elsewhere.  forgotten: in places that are no longer remembered.
    others: lowest loss of the other places, if any; apart: how far these are from the best place,
        in the parameter that differs most, as a fraction of its range.
    noise: standard deviation of a pixel, if what is left is independent noise of pixels alone.
    solved: whether the image equals the target but for what no eye sees (`views.findings`).
    same: how many candidates have had the same image, if all have; else 0 (`views.findings`).
    mismatch: what explains most of what is left, in words, where the renderer cannot draw it.
    clipped: images whose values went beyond black or white; low, high: the extremes of these.
    """

    evaluations: int
    best: float | None
    improved_at: int
    horizon: int
    ended: Sequence[int]
    forgotten: int = 0
    others: float | None = None
    apart: float = 0.0
    noise: float | None = None
    solved: bool = False
    same: int = 0
    mismatch: str | None = None
    clipped: int = 0
    low: float = 0.0
    high: float = 1.0


def status_now(optimizer: FIDE, *, solved: bool) -> Status:
    """State of the run of an optimizer; solved: as of `Facts`."""
    state, best = optimizer.state, optimizer.state.best
    since = state.evaluations - state.retargeted_at
    known = state.moves.known
    others, apart = known.optima.others(known.exchangeability.distance)
    image = None if best is None else best.solution.image
    facts = Facts(
        evaluations=state.evaluations,
        best=None if best is None else best.solution.loss,
        improved_at=state.improved_at,
        horizon=max(_STALLED * state.search.popsize, since // 4),
        ended=[optimum.searches for optimum in known.optima.all],
        forgotten=known.optima.forgotten,
        others=others,
        apart=apart,
        solved=solved,
        noise=None if image is None else state.pixel_noise.left(image, optimizer.views.target),
        same=optimizer.same_images.number,
        clipped=state.clipping.images,
        low=state.clipping.low,
        high=state.clipping.high,
    )
    status, seen = status_of(facts), optimizer.best_image
    if status.code in ("stalled", "unsure", "agreed") and not facts.same and seen is not None:
        why = optimizer.evaluator.mismatch(seen, agreed=status.code == "agreed")
        return status_of(replace(facts, mismatch=why))
    return status


def status_of(facts: Facts) -> Status:
    """Return the first of the states that applies, in the order of `Status.code`."""
    best = facts.best
    if best is None:
        return Status("waiting", "No candidate with a finite loss has been told yet.")
    if facts.solved:
        return Status("solved", f"Solved: the image equals the target to the eye, loss {best:.3g}.")
    if facts.noise is not None:
        return Status(
            "noise",
            f"At the noise floor: loss {best:.3g}. The image differs from the target by "
            "independent noise of single pixels only (standard deviation of a pixel "
            f"{facts.noise:.2g}), as far as this noise lets one see: things of a few pixels that "
            "are about as faint, and larger, fainter ones may be missing. More samples per pixel, "
            "or a target with less noise, would tell more.",
        )
    if facts.same:
        why = "Does render use its parameters, and do their ranges change what is seen?"
        if facts.clipped >= _NEARLY_ALL * facts.evaluations:
            why = (
                "Nearly all were clipped at black or white: they have values from "
                f"{facts.low:.6g} to {facts.high:.6g}. Give value_range=(low, high), which are "
                "black and white in the renders and the target."
            )
        return Status(
            "stalled",
            f"All {facts.same:,} candidates have the same image: loss {best:.3g}. {why}",
        )
    since = facts.evaluations - facts.improved_at
    if since < facts.horizon:
        return Status("improving", f"Still improving: loss {best:.3g}.")
    if facts.mismatch is not None:
        stalled = f"No improvement since evaluation {facts.improved_at:,}: loss {best:.3g}."
        return Status("mismatch", f"{stalled} {facts.mismatch}")
    return _stalled(best, facts)


def _stalled(best: float, facts: Facts) -> Status:
    stalled = f"No improvement since evaluation {facts.improved_at:,}: loss {best:.3g}."
    same, total = (facts.ended or [0])[0], sum(facts.ended) + facts.forgotten
    searches = f"{same} of {total} searches from different starting points ended at this answer"
    if total == 0:
        return Status("stalled", f"{stalled} No search has ended so far: give more renders.")
    if same >= 3 and 2 * same > total:
        return Status("agreed", f"{stalled} {searches}.")
    if total == 1:
        return Status(
            "stalled",
            f"{stalled} It is the answer of one search, no second one began elsewhere. Unless its "
            f"image shows that it is right, {_NEXT}.",
        )
    if same == total:
        return Status("unsure", f"{stalled} {searches}, too few to be sure: {_NEXT}.")
    apart = ""
    if facts.others is not None:
        apart = (
            f" (the best of the others has loss {facts.others:.3g}; parameters differ by up to "
            f"{facts.apart:.0%} of their range)"
        )
    return Status("unsure", f"{stalled} {searches}{apart}, so there may be a better one: {_NEXT}.")
