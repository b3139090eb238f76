"""The record of candidates: which were drawn, which are pending, which were evaluated.

FIDE and all baselines keep one.  A candidate is drawn, handed out and told; users tell in whatever
order and pieces, and the result does not depend on that.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from fide_plugins.population.candidate import Candidate, CandidateRole, form_of, pack, unpack
from fide_plugins.runtime.schema import Schema, array, check, row, whole
from fide_plugins.types import Float64, Mask

_LOST = 2  # generations' worth of spare candidates told, after which members count as lost
_LATE = 3  # times as late as the latest result of late, from which on no result is expected
_ZERO = np.float32(0.0)
_SCHEMA: dict[str, Schema] = {
    **dict.fromkeys(
        (
            "size", "drawn", "generations", "generation_from", "withdrawn", "reserved_from",
            "newest",
        ),
        whole(),
    ),
    "reserved": array("reserved", "d", low=-1e60, high=1e60),
    "delays": row(whole(), whole()),
    "queue": form_of("queued"),
    "pending": form_of("pending"),
    "members": form_of("members"),
    "losses": array("members", high=np.inf),
    "spare": form_of("spare"),
    "spare_losses": array("spare", high=np.inf),
}  # fmt: skip


class Population:
    """Candidates drawn, pending and evaluated.

    Asking for more than is left of a generation draws more members, and any of them complete it;
    those that are told later count in the next one, in which they are `off_distribution`.  A
    generation is complete when `missing` is 0; or, if members are lost, when twice as many spare
    ones were told as it has members, and twice as many as are still `awaited`.

    size: members of the present generation.
    drawn: candidates ever drawn.
    generations: generations completed.
    reserved: (m, d), samples at the end of the queue from which proposals are to be made.
    """

    def __init__(self) -> None:
        self.size = self.drawn = self.generations = 0
        self.reserved: Float64 = np.empty((0, 0))
        self._reserved_from = 0  # index of the first of these
        self._queue: deque[Candidate] = deque()  # drawn, not handed out
        self._pending: dict[int, Candidate] = {}  # handed out, not told, by index
        self._by_point: dict[bytes, list[Candidate]] = {}  # the same, by their points
        self._newest = 0  # highest index handed out
        self._delays = (0, 0)  # by how much more than a generation a result was late: now, before
        self._members: list[tuple[Candidate, float]] = []  # told in the present generation
        self._spare: list[tuple[Candidate, float]] = []  # told, too, and not needed by it
        self._withdrawn = 0  # of its own candidates, in whose place spare ones count
        self._generation_from = 0  # candidates of a lower index belong to an earlier generation

    # -- asking ------------------------------------------------------------------------------------

    @property
    def queued(self) -> int:
        """Candidates of this generation that can be handed out."""
        return len(self._queue)

    @property
    def remaining(self) -> int:
        """Candidates of this generation that are not yet handed out, reserved ones too."""
        return len(self._queue) + len(self.reserved)

    @property
    def has_begun(self) -> bool:
        """Whether something of the present generation is out, told or withdrawn."""
        return self.pending + self.evaluated + self._withdrawn > 0

    def draw(
        self,
        x: Float64,
        z: Float64,
        reserved: Float64 | None = None,
        *,
        pair: bool = False,
        spare: bool = False,
    ) -> None:
        """Queue candidates x (n, d) with their z (n, d) as a generation.

        reserved: samples (m, d), in whose place proposals follow.
        pair: whether the first two are a mirrored pair.
        spare: whether the present generation needs none of x.
        """
        reserved = np.empty((0, 0)) if reserved is None else reserved
        n = len(x) + len(reserved)
        if not spare:
            self.size, self._withdrawn = n, 0
        role = CandidateRole.SPARE if spare else CandidateRole.MEMBER
        pair = pair and len(x) >= 2
        for i, (point, drawn) in enumerate(zip(x, z, strict=True)):
            mirrored = pair and i < 2
            self._queue.append(Candidate(self.drawn + i, point, drawn, role, mirrored=mirrored))
        self.reserved, self._reserved_from = reserved, self.drawn + len(x)
        self.drawn += n

    def add_proposals(self, x: Float64, z: Float64) -> None:
        """Queue proposals x (m, d) with their z (m, d), made from the first reserved samples."""
        for i, (point, near) in enumerate(zip(x, z, strict=True), self._reserved_from):
            self._queue.append(Candidate(i, point, near, proposed=True))
        self.reserved, self._reserved_from = self.reserved[len(x) :], self._reserved_from + len(x)

    def proposed(self, first: int, n: int) -> Mask:
        """Which of n candidates of those that remain are proposals, (n,), from the first on."""
        flags = [candidate.proposed for candidate in self._queue] + [True] * len(self.reserved)
        return np.array(flags[first : first + n], bool)

    def replace(self, first: int, x: Float64, z: Float64, proposed: Mask) -> None:
        """Put points x (m, d) of another distribution, with their z (m, d), in candidates' place.

        first: of those that remain, which is queued, or the first reserved one.
        proposed: (m,), whether each is a proposal.
        """
        for i, (point, drawn, made) in enumerate(zip(x, z, proposed, strict=True), first):
            if i == len(self._queue):  # the next one that is reserved
                self.add_proposals(point[None], drawn[None])
            index = self._queue[i].index
            other = Candidate(index, point, drawn, proposed=bool(made), off_distribution=True)
            self._queue[i] = other

    def hand_out(self) -> Candidate:
        """Next candidate of the queue."""
        candidate = self._queue.popleft()
        self._add_pending(candidate)
        return candidate

    def adopt(
        self,
        x: Float64,
        z: Float64,
        role: CandidateRole = CandidateRole.MEMBER,
        *,
        proposed: bool = False,
        off_distribution: bool = False,
    ) -> None:
        """Take x (d,), which was drawn elsewhere, for a candidate that was handed out."""
        self._add_pending(Candidate(self.new_index(), x, z, role, proposed, off_distribution))

    def new_index(self) -> int:
        """New index, of a candidate that was never drawn: no other has it."""
        self.drawn += 1
        return self.drawn - 1

    # -- pending -----------------------------------------------------------------------------------

    @property
    def pending(self) -> int:
        """Candidates that were handed out and not yet told."""
        return len(self._pending)

    @property
    def awaited(self) -> int:
        """How many of the pending, but for steps, are not much later than all others."""
        oldest = self._newest - _LATE * (self.size + max(self._delays))
        n = 0
        for candidate in reversed(self._pending.values()):  # the last handed out come first
            if candidate.index < oldest:
                break
            n += candidate.role is not CandidateRole.STEP
        return n

    def is_pending(self, x: Float64) -> bool:
        """Whether x (d,) was handed out and not yet told."""
        return bool(self._by_point.get(_key(x)))

    def _add_pending(self, candidate: Candidate) -> None:
        self._pending[candidate.index] = candidate
        self._by_point.setdefault(_key(candidate.x), []).append(candidate)
        self._newest = max(self._newest, candidate.index)

    def take(self, x: Float64) -> Candidate | None:
        """Take x (d,) from the pending candidates; returns it, or None if it is not pending.

        Of several with nearly the same point that with just this one; of these a spare one.
        """
        key = _key(x)
        waiting = self._by_point.get(key)
        if not waiting:
            return None
        which = 0
        if len(waiting) > 1:
            spare = CandidateRole.SPARE
            unlike = [(not np.array_equal(c.x, x), c.role is not spare) for c in waiting]
            which = unlike.index(min(unlike))
        candidate = waiting.pop(which)
        del self._pending[candidate.index]
        if not waiting:
            del self._by_point[key]
        return candidate

    def withdraw(self, x: Float64) -> None:
        """Say that x (d,) will not be told; if it is not pending, nothing happens."""
        candidate = self.take(x)
        if candidate is not None and candidate.role is CandidateRole.MEMBER:
            self._withdrawn += candidate.index >= self._generation_from

    def forget_pending(self) -> None:
        """A restart: what is still pending counts as injected if it is told."""
        self._pending.clear()
        self._by_point.clear()

    # -- telling -----------------------------------------------------------------------------------

    def record(self, x: Float64, loss: float) -> Candidate | None:
        """Enter the loss of x (d,); returns the candidate as it counts, or None: injected."""
        candidate = self.take(x)
        if candidate is None:
            return None
        delay = self._newest - candidate.index - self.size
        self._delays = max(self._delays[0], delay), self._delays[1]
        if candidate.index < self._generation_from:
            candidate = replace(candidate, off_distribution=True)
        if candidate.role is CandidateRole.MEMBER:
            self._members.append((candidate, loss))
        elif candidate.role is CandidateRole.SPARE:
            self._spare.append((candidate, loss))
        return candidate

    @property
    def evaluated(self) -> int:
        """Members of the present generation that were told."""
        return len(self._members)

    @property
    def missing(self) -> int:
        """Results that the present generation lacks, whether they are out, withdrawn or lost."""
        return self.size - len(self._members) - min(self._withdrawn, len(self._spare))

    @property
    def complete(self) -> bool:
        """Whether a whole generation has been told, or what is missing is lost."""
        if self.size > 0 and self.missing <= 0:
            return True
        told = len(self._spare)
        return self.size > 0 and told >= _LOST * self.size and told >= _LOST * self.awaited

    def members(self) -> tuple[list[Candidate], Float64]:
        """Those told in the order in which they were asked, and their losses (n,).

        Spare ones if no other ever came back.
        """
        ordered = sorted(self._members or self._spare, key=lambda pair: pair[0].index)
        losses = np.array([loss for _, loss in ordered], np.float64)
        return [candidate for candidate, _ in ordered], losses

    def close_generation(self) -> tuple[list[Candidate], Float64]:
        """Members and their losses (n,), see `members`; what was never handed out is dropped."""
        members, losses = self.members()
        self._members, self._spare, self._withdrawn = [], [], 0
        self._queue.clear()
        self.reserved = np.empty((0, 0))
        self._delays = (0, self._delays[0])
        self._generation_from = self.drawn
        self.generations += 1
        return members, losses

    # -- saving ------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Everything, as arrays."""
        members, losses = zip(*self._members, strict=True) if self._members else ((), ())
        spare, spare_losses = zip(*self._spare, strict=True) if self._spare else ((), ())
        found = {
            "delays": list(self._delays),
            "queue": pack(self._queue),
            "pending": pack(sorted(self._pending.values(), key=lambda c: c.index)),
            "members": pack(members),
            "losses": np.array(losses, np.float64),
            "spare": pack(spare),
            "spare_losses": np.array(spare_losses, np.float64),
        }
        plain = [name for name in _SCHEMA if name not in found]
        return found | {name: getattr(self, _attribute(name)) for name in plain}

    @classmethod
    def from_state(cls, state: Mapping[str, Any], dim: int) -> Population:
        """Population of points (dim,) as it was when `state_dict` was taken; ValueError if none."""
        check(state, _SCHEMA, {"d": dim}, "population")
        made = cls()
        for name, value in state.items():
            if isinstance(value, int) or name == "reserved":
                setattr(made, _attribute(name), value)
        made._queue.extend(unpack(state["queue"]))
        for candidate in unpack(state["pending"]):
            made._add_pending(candidate)
        made._delays = (*state["delays"],)
        made._members = _with_losses(state["members"], state["losses"])
        made._spare = _with_losses(state["spare"], state["spare_losses"])
        return made


def _attribute(name: str) -> str:
    return name if name in ("size", "drawn", "generations", "reserved") else f"_{name}"


def _with_losses(packed: Mapping[str, Any], losses: Float64) -> list[tuple[Candidate, float]]:
    return list(zip(unpack(packed), losses.tolist(), strict=True))


def search_columns(members: list[Candidate]) -> tuple[Float64, Mask]:
    """What the search distribution learns from: z (n, d), and which it did not draw, (n,)."""
    z = np.array([candidate.z for candidate in members])
    return z, np.array([candidate.proposed or candidate.off_distribution for candidate in members])


def mirrored_pair(members: list[Candidate]) -> tuple[int, int] | None:
    """Where among members, sorted by index, the first whole mirrored pair is; None without.

    One that is off the distribution does not count: it lies along an earlier step of the mean.
    """
    for i, (one, other) in enumerate(pairwise(members)):
        is_pair = one.mirrored and other.mirrored and other.index == one.index + 1
        if is_pair and not one.off_distribution and not other.off_distribution:
            return i, i + 1
    return None


def _key(x: Float64) -> bytes:
    """Name of a point, the same after a way through a renderer in single precision."""
    return (x.astype(np.float32) + _ZERO).tobytes()  # 0 and -0 are one number
