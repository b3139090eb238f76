"""The record of candidates: which were drawn, which are pending, which were evaluated.

FIDE and all baselines keep one.  In which order and pieces users tell changes nothing.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from itertools import pairwise
from operator import attrgetter
from typing import Any

import numpy as np
from torch import Tensor, stack

from fide_plugins.runtime.schema import (
    Plain,
    Schema,
    Sides,
    Stateful,
    array,
    each,
    enum,
    flag,
    form,
    instance,
    maybe,
    packed,
    real,
    row,
    saved,
    tensor,
    whole,
)
from fide_plugins.types import Float64, Mask, Solution

BY_INDEX = attrgetter("index")
"""Key that sorts in the order in which candidates were asked, whatever that of telling."""


class CandidateRole(IntEnum):
    """What a candidate counts for.

    MEMBER: for the generation in which it is told; if it is withdrawn, a spare one does.
    SPARE: for members that do not come back; it is asked beyond a generation that needs exactly its
        own candidates, such as a test.
    STEP: for none, and none waits for it (`proposers.forward`).

    A point that is told and was not pending is no candidate: it is *injected*.
    """

    MEMBER = 0
    SPARE = 1
    STEP = 2


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A point of the cube on its way to the user and back.

    index: its number among all candidates ever drawn.
    x: (d,), what is rendered.
    z: (d,), what the search distribution learns from; into(z) = x.
    role: what it counts for.
    proposed: whether a proposer made it, and not a search distribution.
    off_distribution: whether it is of another distribution than the generation in which it counts:
        of an earlier one, drawn ahead for the next one, or changed by somebody.
    mirrored: whether it is one of the pair that measures the step size, see `search.cma_es`.
    """

    index: int = saved(whole())
    x: Float64 = saved(array("d", low=0.0, high=1.0))
    z: Float64 = saved(array("d", low=-1e60, high=1e60))
    role: CandidateRole = saved(enum(CandidateRole), default=CandidateRole.MEMBER)
    proposed: bool = saved(flag, default=False)
    off_distribution: bool = saved(flag, default=False)
    mirrored: bool = saved(flag, default=False)


@dataclass(frozen=True, slots=True, eq=False)
class TrainingSample:
    """An evaluation whose image is known: what proposers and moves learn from.

    index: order of asking.
    x: (d,), parameters.
    tokens: (T, C), features of the image.
    loss: finite.
    evaluation: number of the evaluation, from 0, in the order of telling.
    """

    index: int = saved(whole())
    x: Float64 = saved(array("d", low=0.0, high=1.0))
    tokens: Tensor = saved(tensor("T", "C"))
    loss: float = saved(real())
    evaluation: int = saved(whole())


def columns(samples: Sequence[TrainingSample]) -> tuple[Float64, Tensor, Float64]:
    """Of samples, at least one: x (n, d), tokens (n, T, C), losses (n,)."""
    x = np.array([sample.x for sample in samples])
    losses = np.array([sample.loss for sample in samples])
    return x, stack([sample.tokens for sample in samples]), losses


_SOLUTION: dict[str, Schema] = {
    "x": array("d", low=0.0, high=1.0),
    "loss": real(),
    "evaluation": whole(),
    "image": maybe(array("H", "W", 3, low=0.0, high=1.0)),
}


@dataclass(frozen=True, slots=True)
class Best:
    """The best point told so far.

    solution: the point.
    index: number of its candidate.
    mean: (d,), mean of the search that asked it; the point itself if none did.
    search_number: of the search that asked it; 0 for none.
    """

    solution: Solution = saved(instance(Solution, _SOLUTION))
    index: int = saved(whole())
    mean: Float64 = saved(array("d", low=-1e60, high=1e60))
    search_number: int = saved(whole())

    def state_dict(self) -> dict[str, Any]:
        """All of it but what is computed when it is read; arrays are those in use, not copies."""
        own = {name: getattr(self, name) for name in form(Best)}
        return own | {"solution": {k: getattr(self.solution, k) for k in _SOLUTION}}


# -- the record -----------------------------------------------------------------------------------

_LOST = 2  # generations' worth of spare candidates told, after which members count as lost
_LATE = 3  # times as late as the latest result of late, from which on no result is expected
_ZERO = np.float32(0.0)
_TOLD: Schema = each(row(instance(Candidate), real(high=np.inf)))


@dataclass(eq=False)
class Population(Stateful):
    """Candidates drawn, pending and evaluated.

    Asking for more than is left of a generation draws more members, and any of them complete it;
    those that are told later count in the next one, in which they are `off_distribution`.  A
    generation is complete when `missing` is 0; or, if members are lost, when twice as many spare
    ones were told as it has members, and twice as many as are still `awaited`.

    size: members of the present generation.
    drawn: candidates ever drawn.
    generations: generations completed.
    queue: candidates of this generation that can be handed out.
    reserved: (m, d), samples at the end of the queue from which proposals are to be made.
    pending: candidates that were handed out and not yet told, by index.
    told, spare: of the present generation with their losses: members, and what it did not need.
    withdrawn: of its own candidates, in whose place spare ones count.
    reserved_from, generation_from, newest: index of the first that is reserved, of the first that
        is not of an earlier generation, and of the last that was handed out.
    delays: by how much more than a generation a result was late, in this one and the one before.
    """

    size: int = saved(whole(), default=0)
    drawn: int = saved(whole(), default=0)
    generations: int = saved(whole(), default=0)
    withdrawn: int = saved(whole(), default=0)
    reserved_from: int = saved(whole(), default=0)
    generation_from: int = saved(whole(), default=0)
    newest: int = saved(whole(), default=0)
    delays: tuple[int, int] = saved(row(whole(), whole()), default=(0, 0))
    reserved: Float64 = saved(
        array("reserved", "d", low=-1e60, high=1e60), default_factory=lambda: np.empty((0, 0))
    )
    queue: deque[Candidate] = saved(each(instance(Candidate)), default_factory=deque)
    pending: dict[int, Candidate] = saved(each(instance(Candidate)), default_factory=dict)
    told: list[tuple[Candidate, float]] = saved(_TOLD, default_factory=list)
    spare: list[tuple[Candidate, float]] = saved(_TOLD, default_factory=list)
    _by_point: dict[bytes, list[Candidate]] = field(init=False, default_factory=dict)

    # -- asking ------------------------------------------------------------------------------------

    @property
    def remaining(self) -> int:
        """Candidates of this generation that are not yet handed out, reserved ones too."""
        return len(self.queue) + len(self.reserved)

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
            self.size, self.withdrawn = n, 0
        role = CandidateRole.SPARE if spare else CandidateRole.MEMBER
        pair = pair and len(x) >= 2
        for i, (point, drawn) in enumerate(zip(x, z, strict=True)):
            mirrored = pair and i < 2
            self.queue.append(Candidate(self.drawn + i, point, drawn, role, mirrored=mirrored))
        self.reserved, self.reserved_from = reserved, self.drawn + len(x)
        self.drawn += n

    def add_proposals(self, x: Float64, z: Float64) -> None:
        """Queue proposals x (m, d) with their z (m, d), made from the first reserved samples."""
        for i, (point, near) in enumerate(zip(x, z, strict=True), self.reserved_from):
            self.queue.append(Candidate(i, point, near, proposed=True))
        self.reserved, self.reserved_from = self.reserved[len(x) :], self.reserved_from + len(x)

    def replace(self, first: int, x: Float64, z: Float64, proposed: Mask) -> None:
        """Put points x (m, d) of another distribution, with their z (m, d), in candidates' place.

        first: of those that remain, which is queued, or the first reserved one.
        proposed: (m,), whether each is a proposal.
        """
        for i, (point, drawn, made) in enumerate(zip(x, z, proposed, strict=True), first):
            if i == len(self.queue):  # the next one that is reserved
                self.add_proposals(point[None], drawn[None])
            index = self.queue[i].index
            other = Candidate(index, point, drawn, proposed=bool(made), off_distribution=True)
            self.queue[i] = other

    def hand_out(self) -> Candidate:
        """Next candidate of the queue."""
        candidate = self.queue.popleft()
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
        self._add_pending(Candidate(self.drawn, x, z, role, proposed, off_distribution))
        self.drawn += 1

    # -- pending -----------------------------------------------------------------------------------

    @property
    def awaited(self) -> int:
        """How many of the pending, but for steps, are not much later than all others."""
        oldest = self.newest - _LATE * (self.size + max(self.delays))
        n = 0
        for candidate in reversed(self.pending.values()):  # the last handed out come first
            if candidate.index < oldest:
                break
            n += candidate.role is not CandidateRole.STEP
        return n

    def is_pending(self, x: Float64) -> bool:
        """Whether x (d,) was handed out and not yet told."""
        return bool(self._by_point.get(_key(x)))

    def _add_pending(self, candidate: Candidate) -> None:
        self.pending[candidate.index] = candidate
        self._by_point.setdefault(_key(candidate.x), []).append(candidate)
        self.newest = max(self.newest, candidate.index)

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
        del self.pending[candidate.index]
        if not waiting:
            del self._by_point[key]
        return candidate

    def withdraw(self, x: Float64) -> None:
        """Say that x (d,) will not be told; if it is not pending, nothing happens."""
        candidate = self.take(x)
        if candidate is not None and candidate.role is CandidateRole.MEMBER:
            self.withdrawn += candidate.index >= self.generation_from

    def forget_pending(self) -> None:
        """A restart: what is still pending counts as injected if it is told."""
        self.pending.clear()
        self._by_point.clear()

    # -- telling -----------------------------------------------------------------------------------

    def record(self, x: Float64, loss: float) -> Candidate | None:
        """Enter the loss of x (d,); returns the candidate as it counts, or None: injected."""
        candidate = self.take(x)
        if candidate is None:
            return None
        delay = self.newest - candidate.index - self.size
        self.delays = max(self.delays[0], delay), self.delays[1]
        if candidate.index < self.generation_from:
            candidate = replace(candidate, off_distribution=True)
        if candidate.role is CandidateRole.MEMBER:
            self.told.append((candidate, loss))
        elif candidate.role is CandidateRole.SPARE:
            self.spare.append((candidate, loss))
        return candidate

    @property
    def missing(self) -> int:
        """Results that the present generation lacks, whether they are out, withdrawn or lost."""
        return self.size - len(self.told) - min(self.withdrawn, len(self.spare))

    @property
    def complete(self) -> bool:
        """Whether a whole generation has been told, or what is missing is lost."""
        if self.size > 0 and self.missing <= 0:
            return True
        told = len(self.spare)
        return self.size > 0 and told >= _LOST * self.size and told >= _LOST * self.awaited

    def members(self) -> tuple[list[Candidate], Float64]:
        """Those told in the order in which they were asked, and their losses (n,).

        Spare ones if no other ever came back.
        """
        ordered = sorted(self.told or self.spare, key=lambda pair: pair[0].index)
        losses = np.array([loss for _, loss in ordered], np.float64)
        return [candidate for candidate, _ in ordered], losses

    def close_generation(self) -> tuple[list[Candidate], Float64]:
        """Members and their losses (n,), see `members`; what was never handed out is dropped."""
        members, losses = self.members()
        self.told, self.spare, self.withdrawn = [], [], 0
        self.queue.clear()
        self.reserved = np.empty((0, 0))
        self.delays = (0, self.delays[0])
        self.generation_from = self.drawn
        self.generations += 1
        return members, losses

    # -- saving ------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Everything."""
        pending = sorted(self.pending.values(), key=BY_INDEX)
        return super().state_dict() | {"pending": packed(pending)}

    def load_state_dict(self, state: Plain, sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; ValueError if it is none.  sides: d."""
        super().load_state_dict(state, sides)
        waiting: Any = self.pending
        self.queue, newest, self.pending = deque(self.queue), self.newest, {}
        self._by_point.clear()
        for candidate in waiting:
            self._add_pending(candidate)
        self.newest = newest


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


# -- what is remembered for later pictures, and for `Solution.std` ---------------------------------

_MEGABYTE = 2**20
_LEAST = 4096  # bytes of a sample; its objects take about as much, however few numbers they hold


@dataclass(eq=False)
class Memory(Stateful):
    """Samples of a run, at most `megabytes` of tokens and parameters; 0: none.

    Half of the room is for the latest samples.  The other half is for every `stride`-th of those
    that have left the first, which doubles whenever the room is full: they are spread evenly over
    the run.  left: how many have.
    """

    megabytes: float
    earlier: list[TrainingSample] = saved(each(instance(TrainingSample)), default_factory=list)
    latest: deque[TrainingSample] = saved(each(instance(TrainingSample)), default_factory=deque)
    left: int = saved(whole(), default=0)
    stride: int = saved(whole(1), default=1)

    @property
    def samples(self) -> list[TrainingSample]:
        """All of them, the earliest first."""
        return [*self.earlier, *self.latest]

    def add(self, sample: TrainingSample) -> None:
        """Remember a sample; others may be forgotten for it."""
        each = max(_LEAST, sample.tokens.nbytes + sample.x.nbytes)
        room = int(min(self.megabytes * _MEGABYTE / each, sys.maxsize))  # there may be no limit
        if room < 2:
            return
        self.latest.append(sample)
        if len(self.latest) <= room // 2:
            return
        sample, self.left = self.latest.popleft(), self.left + 1
        if self.left % self.stride == 0:
            self.earlier.append(sample)
        if len(self.earlier) > room - room // 2:
            self.earlier = self.earlier[1::2]
            self.stride *= 2

    def set_losses(self, losses: Sequence[float]) -> None:
        """Give all samples, in the order of `samples`, the losses (n,) of another target."""
        every = [replace(one, loss=x) for one, x in zip(self.samples, losses, strict=True)]
        self.latest = deque(every[len(self.earlier) :])
        self.earlier = every[: len(self.earlier)]

    def load_state_dict(self, state: Plain, sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; ValueError if it is none.  sides: d, T, C, device."""
        super().load_state_dict(state, sides)
        self.latest = deque(self.latest)
