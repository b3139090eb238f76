"""What a trial carries for other processes, as system attributes: small, versioned JSON.

================  ==================================================================================
``fide:ask``      written when parameters are drawn: which candidate of which generation it is, and
                  what was decided about other trials (see `log`)
``fide:image``    written by `tell_image`: the features of the image (see `compact`)
``fide:seed``     of the study: the seed of samplers that were given none
================  ==================================================================================

A database may be shared with anybody, so what is read is checked in every field, never executed,
and ignored where it is not what it should be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

__all__ = [
    "ASK",
    "IMAGE",
    "MOST_NAMED",
    "SEED",
    "Ask",
    "is_seed",
    "read_ask",
    "read_image",
    "write_image",
]

ASK, IMAGE, SEED = "fide:ask", "fide:image", "fide:seed"

MOST_NAMED = 8
"""Trials that a record names at most, of each kind; the others wait for the next one."""

_VERSION = 1
_LARGEST = 2**53


@dataclass(frozen=True, slots=True)
class Ask:
    """What was asked in a trial.

    model: digest of search space and settings; generation and slot are names among equals.
    generation, slot: name of the candidate, see `fide_plugins.replica`.
    began: generation in which the search of that generation began.
    proposed: whether a proposer made it.
    passed: numbers of unfinished trials that are no longer waited for.
    late: numbers of such trials that have finished; they count here.
    """

    model: str
    generation: int
    slot: int
    began: int = 0
    proposed: bool = False
    passed: tuple[int, ...] = ()
    late: tuple[int, ...] = ()

    def about_trials_before(self, number: int) -> Ask:
        """Without what is said of trials from `number` on; only earlier ones can be meant."""
        if all(n < number for n in (*self.passed, *self.late)):
            return self
        passed, late = (tuple(n for n in said if n < number) for said in (self.passed, self.late))
        return replace(self, passed=passed, late=late)

    def to_json(self) -> dict[str, Any]:
        """What is stored."""
        record: dict[str, Any] = {"v": _VERSION, "m": self.model}
        record |= {"g": self.generation, "i": self.slot}
        optional = {
            "b": self.began,
            "p": int(self.proposed),
            "passed": list(self.passed),
            "late": list(self.late),
        }
        return record | {key: value for key, value in optional.items() if value}


def read_ask(record: Any) -> Ask | None:
    """Undo `to_json`; None if it is something else."""
    if not isinstance(record, dict) or record.get("v") != _VERSION:
        return None
    model, passed, late = record.get("m"), record.get("passed", []), record.get("late", [])
    counts = [record.get("g"), record.get("i"), record.get("b", 0), record.get("p", 0)]
    if not isinstance(model, str) or not isinstance(passed, list) or not isinstance(late, list):
        return None
    if max(len(passed), len(late)) > MOST_NAMED or not _whole([*counts, *passed, *late]):
        return None
    generation, slot, began, proposed = counts
    return Ask(model, generation, slot, began, bool(proposed), tuple(passed), tuple(late))


def _whole(numbers: list[Any]) -> bool:
    return all(type(number) is int and 0 <= number < _LARGEST for number in numbers)


def is_seed(record: Any) -> bool:
    """Whether that can be the seed of a study."""
    return _whole([record])


def write_image(codec: str, code: str) -> dict[str, Any]:
    """Return what is stored of an image: its `code` by the codec of that digest."""
    return {"v": _VERSION, "c": codec, "d": code}


def read_image(record: Any, codec: str) -> str | None:
    """Code of an image that `codec` can read; None if it is something else."""
    if not isinstance(record, dict) or record.get("v") != _VERSION or record.get("c") != codec:
        return None
    code = record.get("d")
    return code if isinstance(code, str) else None
