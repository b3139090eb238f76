"""Candidates that were handed out and not yet told.

A candidate that is never told stays here until so many others are pending that memory would grow.
After that it counts as injected.  Long before, nothing waits for it, see `Pending.awaited`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fide_plugins.population.candidate import Candidate, CandidateRole, form_of, pack, unpack
from fide_plugins.runtime.schema import Schema, row, whole
from fide_plugins.types import Float64

__all__ = ["SCHEMA", "Pending"]

_MOST = 20_000  # candidates; or twice as many as were asked at once, if that is more
_ZERO = np.float32(0.0)
_LONG = 3  # times as late as the latest result of late, from which on no result is expected

SCHEMA: Schema = {
    "candidates": form_of("pending"),
    "most": whole(),
    "newest": whole(),
    "lags": row(whole(), whole()),
}


class Pending:
    """Candidates in the order in which they were handed out, and by their points."""

    def __init__(self) -> None:
        self._by_index: dict[int, Candidate] = {}
        self._by_point: dict[bytes, list[Candidate]] = {}
        self._most = _MOST
        self._newest = 0  # highest index handed out
        self._lags = (0, 0)  # by how much more than a generation a result was late: now, before

    def __len__(self) -> int:
        return len(self._by_index)

    def __iter__(self) -> Iterator[Candidate]:
        return iter(self._by_index.values())

    def __contains__(self, x: Float64) -> bool:
        return bool(self._by_point.get(_key(x)))

    def expect(self, n: int) -> None:
        """Prepare for n candidates that are handed out at once: all of them may be pending."""
        self._most = max(self._most, 2 * n)

    def add(self, candidate: Candidate) -> None:
        """A candidate was handed out; if there are too many, the oldest is given up."""
        self._await(candidate)
        self._newest = max(self._newest, candidate.index)
        if len(self._by_index) > self._most:
            self._pop(_key(next(iter(self)).x), 0)

    def _await(self, candidate: Candidate) -> None:
        self._by_index[candidate.index] = candidate
        self._by_point.setdefault(_key(candidate.x), []).append(candidate)

    def take(self, x: Float64) -> Candidate | None:
        """Take the candidate x (d,) away; None if none is.

        Of several with nearly the same point that with just this one; of these a spare one.
        """
        key = _key(x)
        if not (waiting := self._by_point.get(key)):
            return None
        unlike = [(not np.array_equal(c.x, x), c.role is not CandidateRole.SPARE) for c in waiting]
        return self._pop(key, unlike.index(min(unlike)))

    def _pop(self, key: bytes, which: int) -> Candidate:
        candidate = self._by_point[key].pop(which)
        del self._by_index[candidate.index]
        if not self._by_point[key]:
            del self._by_point[key]
        return candidate

    def clear(self) -> None:
        """Forget all."""
        self._by_index.clear()
        self._by_point.clear()

    # -- how long to wait --------------------------------------------------------------------------

    def note_result(self, candidate: Candidate, size: int) -> None:
        """Note how late a result came, in a generation of that size."""
        lag = self._newest - candidate.index - size
        self._lags = max(self._lags[0], lag), self._lags[1]

    def begin_generation(self) -> None:
        """Remember how late results were in this generation and in the one before."""
        self._lags = (0, self._lags[0])

    def awaited(self, size: int) -> int:
        """How many are not much later than all others, in a generation of that size.

        A lost one never comes.  For steps no generation waits.
        """
        oldest = self._newest - _LONG * (size + max(self._lags))
        n = 0
        for candidate in reversed(self._by_index.values()):  # the last handed out come first
            if candidate.index < oldest:
                break
            n += candidate.role is not CandidateRole.STEP
        return n

    # -- saving ------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Everything, as arrays."""
        return {
            "candidates": pack(sorted(self, key=lambda c: c.index)),
            "most": self._most,
            "newest": self._newest,
            "lags": list(self._lags),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Pending:
        """Undo `state_dict`, whose form is `SCHEMA`."""
        pending = cls()
        for candidate in unpack(state["candidates"]):
            pending._await(candidate)
        pending._most, pending._newest = state["most"], state["newest"]
        pending._lags = (*state["lags"],)
        return pending


def _key(x: Float64) -> bytes:
    """Name of a point, the same after a way through a renderer in single precision."""
    return (x.astype(np.float32) + _ZERO).tobytes()  # 0 and -0 are one number
