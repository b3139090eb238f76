"""Who was asked what: the bookkeeping of generations for users who ask and tell as they please.

A generation is complete as soon as as many candidates that were asked have been told as were last
drawn for it, in whatever order and pieces; its members are then put in the order in which they were
asked, so that the result does not depend on the order of telling.

- Asking for more than is left of a generation draws more from the same distribution.
- A candidate told after its generation was completed counts for the generation in which it
  arrives, marked as late: it is not of that generation's distribution.
- A candidate asked before a restart, told twice, or never asked at all is a *guest*: it tells
  about the renderer, not about the search distribution.
- The proposals of a generation are its last candidates, and may be made only when the first of them
  is due.
- A candidate that is never told is waited for until so many others are out that memory would grow;
  after that it is a guest, too.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from fide_plugins.points import Float64

__all__ = ["Candidate", "Ledger", "Propose"]

Propose: TypeAlias = Callable[[], tuple[Float64, Float64]]

_MOST_OUT = 20_000  # candidates that are waited for; the oldest are given up


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A point of the cube on its way to the user and back.

    index: its number among all candidates ever drawn.
    x: (d,), what is rendered.
    z: (d,), what the search distribution learns from; into(z) = x.
    proposed: whether a proposer made it, and not the search distribution.
    late: whether it was told after its own generation was complete.
    """

    index: int
    x: Float64
    z: Float64
    proposed: bool
    late: bool = False


class Ledger:
    """Candidates drawn, asked and told."""

    def __init__(self) -> None:
        self.size = 0  # members of the present generation
        self.drawn = 0  # candidates ever drawn
        self.generations = 0  # completed
        self._queue: deque[Candidate] = deque()  # drawn, not handed out
        self._due = 0  # proposals that come after the queue and are not made yet
        self._due_from = 0  # index of the first of them
        self._propose: Propose | None = None  # makes them
        self._asked: dict[bytes, list[Candidate]] = {}  # handed out, not told
        self._out = 0  # how many these are
        self._told: list[tuple[Candidate, float]] = []  # of the generation that is under way
        self._generation_from = 0  # candidates of a lower index belong to an earlier generation

    @property
    def left(self) -> int:
        """Candidates of this generation that were drawn and not yet handed out."""
        return len(self._queue) + self._due

    @property
    def at_hand(self) -> int:
        """How many of these are made; all that are left if none is."""
        return len(self._queue) or self._due

    @property
    def asked(self) -> int:
        """Candidates that were handed out and not yet told."""
        return self._out

    def draw(self, x: Float64, z: Float64, due: int = 0, propose: Propose | None = None) -> None:
        """Queue candidates x (n, d) with their z (n, d); with those due they make a generation.

        propose: makes x and z, (due, d) each, of the proposals that come after these.
        """
        self.size = len(x) + due
        for row in zip(x, z, strict=True):
            self._queue.append(Candidate(self.drawn, *row, proposed=False))
            self.drawn += 1
        self._due, self._due_from, self._propose = due, self.drawn, propose
        self.drawn += due

    def make_proposals(self) -> None:
        """Put into the queue what is due; if that raises, it is tried again the next time."""
        if self._due and self._propose is not None:
            made = zip(*self._propose(), strict=True)
            for index, (x, z) in enumerate(made, self._due_from):
                self._queue.append(Candidate(index, x, z, proposed=True))
            self._drop_due()

    def _drop_due(self) -> None:
        self._due, self._propose = 0, None

    def hand_out(self) -> Float64:
        """Next candidate of the generation, (d,)."""
        if not self._queue:
            self.make_proposals()
        return self._hand_out(self._queue.popleft()).x

    def hand_out_all(self) -> list[Candidate]:
        """Hand out all that is left of the generation."""
        self.make_proposals()
        handed_out = [self._hand_out(candidate) for candidate in self._queue]
        self._queue.clear()
        return handed_out

    def adopt(self, x: Float64, z: Float64, *, proposed: bool = False, late: bool = False) -> None:
        """Take x (d,), which was drawn elsewhere, for one that was handed out."""
        self._hand_out(Candidate(self.drawn, x, z, proposed, late))
        self.drawn += 1

    def _hand_out(self, candidate: Candidate) -> Candidate:
        self._wait_for(candidate)
        if self._out > _MOST_OUT:
            self._pop(next(iter(self._asked)), 0)
        return candidate

    def _wait_for(self, candidate: Candidate) -> None:
        self._asked.setdefault(_key(candidate.x), []).append(candidate)
        self._out += 1

    def take_back(self, x: Float64, loss: float) -> int | None:
        """Note that x (d,) was told; returns its index, or None if it is a guest."""
        candidate = self.withdraw(x)
        if candidate is None:
            return None
        if candidate.index < self._generation_from:
            candidate = replace(candidate, late=True)
        self._told.append((candidate, loss))
        return candidate.index

    def withdraw(self, x: Float64) -> Candidate | None:
        """Take x (d,) from those that are out; returns it, or None if it is not out."""
        key = _key(x)
        waiting = self._asked.get(key)
        if not waiting:
            return None
        exact = (i for i, candidate in enumerate(waiting) if np.array_equal(candidate.x, x))
        return self._pop(key, next(exact, 0))

    def _pop(self, key: bytes, which: int) -> Candidate:
        candidate = self._asked[key].pop(which)
        self._out -= 1
        if not self._asked[key]:
            del self._asked[key]
        return candidate

    @property
    def told(self) -> int:
        """Candidates of the generation that were told."""
        return len(self._told)

    def told_so_far(self) -> tuple[list[Candidate], Float64]:
        """Those in the order they were asked, and their losses (n,)."""
        told = sorted(self._told, key=lambda pair: pair[0].index)
        return [candidate for candidate, _ in told], np.array([loss for _, loss in told])

    @property
    def complete(self) -> bool:
        """Whether a whole generation has been told."""
        return 0 < self.size <= len(self._told)

    def close_generation(self) -> tuple[list[Candidate], Float64]:
        """Members of the generation, in the order they were asked, and their losses (n,).

        What was drawn for it and never handed out is thrown away.
        """
        members, losses = self.told_so_far()
        self._told = []
        self._queue.clear()
        self._drop_due()
        self._generation_from = self.drawn
        self.generations += 1
        return members, losses

    def close_search(self) -> None:
        """After a restart: forget what is still out; it is a guest if it comes back."""
        self._asked.clear()
        self._out = 0

    def state_dict(self) -> dict[str, Any]:
        """Everything, as arrays; what is due is made first."""
        self.make_proposals()
        waiting = [c for several in self._asked.values() for c in several]
        return {
            "size": self.size,
            "drawn": self.drawn,
            "generations": self.generations,
            "generation_from": self._generation_from,
            "queue": _pack(list(self._queue)),
            "asked": _pack(sorted(waiting, key=lambda c: c.index)),
            "told": _pack([c for c, _ in self._told]),
            "losses": np.array([loss for _, loss in self._told], np.float64),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Ledger:
        """Ledger as it was when `state_dict` was taken."""
        ledger = cls()
        ledger.size = int(state["size"])
        ledger.drawn = int(state["drawn"])
        ledger.generations = int(state["generations"])
        ledger._generation_from = int(state["generation_from"])
        ledger._queue.extend(_unpack(state["queue"]))
        for candidate in _unpack(state["asked"]):
            ledger._wait_for(candidate)
        losses = state["losses"].tolist()
        ledger._told = list(zip(_unpack(state["told"]), losses, strict=True))
        return ledger


def _key(x: Float64) -> bytes:
    """Name of a point, the same after a way through a renderer in single precision."""
    return (x.astype(np.float32) + np.float32(0.0)).tobytes()  # 0 and -0 are one number


def _pack(candidates: list[Candidate]) -> dict[str, Any]:
    return {
        "index": np.array([c.index for c in candidates], np.int64),
        "x": np.array([c.x for c in candidates]),
        "z": np.array([c.z for c in candidates]),
        "proposed": np.array([c.proposed for c in candidates], bool),
        "late": np.array([c.late for c in candidates], bool),
    }


def _unpack(packed: Mapping[str, Any]) -> list[Candidate]:
    flags = packed["proposed"].tolist(), packed["late"].tolist()
    columns = (packed["index"].tolist(), packed["x"], packed["z"], *flags)
    return [Candidate(i, x.copy(), z.copy(), *f) for i, x, z, *f in zip(*columns, strict=True)]
