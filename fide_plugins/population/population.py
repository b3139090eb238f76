"""The record of candidates: which were drawn, which are pending, which were evaluated.

FIDE and all baselines keep one.  A generation is complete as soon as as many candidates that were
asked have been told as were last drawn for it, in whatever order and pieces.  Its members are then
sorted in the order in which they were asked, so that the result does not depend on the order of
telling.

- Asking for more than is left of a generation draws more from the same distribution.
- A test or a restart needs its own candidates, and what is asked beyond these is *extra*: it does
  not count towards the generation, unless own candidates were withdrawn, in whose place it counts,
  or so many extra ones were told that the own ones are lost.
- A candidate told after its generation was completed counts for the generation in which it
  arrives, marked as late: it is not of that generation's distribution.
- A candidate that was asked before a restart, told twice, or never asked at all is *injected*: it
  tells about the renderer, not about the search distribution.
- A *step* comes between two generations and counts in none (`proposers.steps`).
- The proposals of a generation are its last candidates.  They are made when they are asked for,
  from all that was told by then, those that are asked together in one call; or all of them when
  the first one is.
- A candidate that is never told stays pending until so many others are pending that memory would
  grow.  After that it counts as injected.  Long before, nothing waits for it, see `awaited`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np

from fide_plugins.population.candidate import Candidate, form_of, pack, unpack
from fide_plugins.runtime.schema import Schema, array, check, row, whole
from fide_plugins.types import Float64, Mask

__all__ = ["Population", "Propose", "mirrored_pair", "search_columns"]

Propose: TypeAlias = Callable[[Float64], tuple[Float64, Float64]]
"""From samples (m, d): x and z of proposals, (m, d) each."""

_LOST = 2  # generations' worth of extra candidates told, after which own ones count as lost
_LONG = 3  # times as late as the latest result of late, from which on no result is expected
_MOST_PENDING = 20_000  # candidates; or twice as many as were asked at once, if that is more


class Population:
    """Candidates drawn, pending and evaluated."""

    def __init__(self) -> None:
        self.size = 0
        """Members of the present generation."""
        self.drawn = 0
        """Candidates ever drawn."""
        self.generations = 0
        """Generations completed."""
        self._queue: deque[Candidate] = deque()  # drawn, not handed out
        self._unmade: Float64 = np.empty((0, 0))  # samples for proposals that are not made yet
        self._unmade_from = 0  # index of the first of these proposals
        self._propose: Propose | None = None  # makes them
        self._singly = False  # each when it is asked for
        self._pending: dict[bytes, list[Candidate]] = {}  # handed out, not told
        self._n_pending = 0
        self._most_pending = _MOST_PENDING
        self._evaluated: list[tuple[Candidate, float]] = []  # of the present generation
        self._extra: list[tuple[Candidate, float]] = []  # told, too, and not needed by it
        self._withdrawn = 0  # of its own candidates, in whose place extra ones count
        self._generation_from = 0  # candidates of a lower index belong to an earlier generation
        self._newest = 0  # highest index handed out
        self._lags = (0, 0)  # by how much more than a generation a result was late: now, before

    # -- asking ------------------------------------------------------------------------------------

    @property
    def remaining(self) -> int:
        """Candidates of this generation that were drawn and not yet handed out."""
        return len(self._queue) + len(self._unmade)

    @property
    def ready(self) -> int:
        """How many of these wait for nothing; all that remain if none is made."""
        return self.remaining if self._singly else len(self._queue) or len(self._unmade)

    @property
    def unmade(self) -> int:
        """How many of these are proposals that are not made yet."""
        return len(self._unmade)

    @property
    def pending(self) -> int:
        """Candidates that were handed out and not yet told."""
        return self._n_pending

    @property
    def awaited(self) -> int:
        """Those of the pending that are not much later than all others: a lost one never comes.

        But for steps: no generation waits for them.
        """
        oldest = self._newest - _LONG * (self.size + max(self._lags))
        n = 0
        for several in reversed(self._pending.values()):  # the last that were handed out come first
            if several[-1].index < oldest:
                break
            n += sum(not candidate.step for candidate in several)
        return n

    def draw(
        self,
        x: Float64,
        z: Float64,
        unmade: Float64 | None = None,
        *,
        pair: bool = False,
        extra: bool = False,
    ) -> None:
        """Queue candidates x (n, d) with their z (n, d) as a generation.

        unmade: samples (m, d), from which the proposals that follow are made, see `propose_by`.
        pair: whether the first two are a mirrored pair.
        extra: whether the present generation needs none of x.
        """
        unmade = np.empty((0, 0)) if unmade is None else unmade
        if not extra:
            self.size, self._withdrawn = len(x) + len(unmade), 0
        pair = pair and len(x) >= 2
        for i, point in enumerate(zip(x, z, strict=True)):
            self._queue.append(Candidate(self.drawn, *point, mirrored=pair and i < 2, extra=extra))
            self.drawn += 1
        self._unmade, self._unmade_from = unmade, self.drawn
        self.drawn += len(unmade)

    def propose_by(self, propose: Propose, *, singly: bool) -> None:
        """Say what makes the proposals; a checkpoint cannot hold it.

        singly: each proposal when it is asked for, otherwise all when the first one is.  Those that
            are asked for together are made by one call of `propose`.
        """
        self._propose, self._singly = propose, singly

    def make_proposals(self, n: int | None = None) -> None:
        """Make proposals until n candidates are queued; all if n is None, or if not `singly`.

        If that raises, the next call tries again.
        """
        if not len(self._unmade) or (n is not None and n <= len(self._queue)):
            return
        assert self._propose is not None
        m = len(self._unmade) if n is None or not self._singly else n - len(self._queue)
        now = self._unmade[:m]
        made = zip(*self._propose(now), strict=True)
        for index, (x, z) in enumerate(made, self._unmade_from):
            self._queue.append(Candidate(index, x, z, proposed=True))
        self._unmade, self._unmade_from = self._unmade[len(now) :], self._unmade_from + len(now)

    def settle(self) -> None:
        """Make the proposals that no further result can change."""
        if not self._singly:
            self.make_proposals()

    def expect(self, n: int) -> None:
        """Prepare for n candidates that are asked at once: all of them may be pending."""
        self._most_pending = max(self._most_pending, 2 * n, 2 * self.size)

    def hand_out(self) -> Candidate:
        """Next candidate of the generation."""
        self.make_proposals(1)
        return self._hand_out(self._queue.popleft())

    def proposed(self, first: int, n: int) -> Mask:
        """Which of n candidates of those that remain are proposals, (n,), from the first on."""
        flags = [candidate.proposed for candidate in self._queue] + [True] * len(self._unmade)
        return np.array(flags[first : first + n], bool)

    def replace(self, first: int, x: Float64, z: Float64, proposed: Mask) -> None:
        """Put points x (m, d) with their z (m, d) in the place of candidates, as late ones.

        first: of those that remain, which is queued, or the next proposal.
        proposed: (m,), whether each is a proposal.
        """
        for i, (point, drawn, made) in enumerate(zip(x, z, proposed, strict=True), first):
            if i == len(self._queue):
                self._queue.append(Candidate(self._unmade_from, point, drawn))
                self._unmade, self._unmade_from = self._unmade[1:], self._unmade_from + 1
            index = self._queue[i].index
            self._queue[i] = Candidate(index, point, drawn, proposed=bool(made), late=True)

    def hand_out_all(self) -> list[Candidate]:
        """All candidates of the generation that remain."""
        self.expect(self.remaining)
        self.make_proposals()
        handed_out = [self._hand_out(candidate) for candidate in self._queue]
        self._queue.clear()
        return handed_out

    def adopt(self, x: Float64, z: Float64, **flags: Any) -> None:
        """Take x (d,), which was drawn elsewhere, for a candidate that was handed out.

        flags: further fields of `Candidate`.
        """
        self._hand_out(Candidate(self.drawn, x, z, **flags))
        self.drawn += 1

    def _hand_out(self, candidate: Candidate) -> Candidate:
        self._await(candidate)
        self._newest = max(self._newest, candidate.index)
        if self._n_pending > self._most_pending:
            self._pop(next(iter(self._pending)), 0)
        return candidate

    def _await(self, candidate: Candidate) -> None:
        self._pending.setdefault(_key(candidate.x), []).append(candidate)
        self._n_pending += 1

    # -- telling -----------------------------------------------------------------------------------

    def record(self, x: Float64, loss: float) -> Candidate | None:
        """Enter the loss of x (d,); returns the candidate as it was asked, or None: injected."""
        candidate = self.take(x)
        if candidate is None:
            return None
        lag = self._newest - candidate.index - self.size
        self._lags = max(self._lags[0], lag), self._lags[1]
        if candidate.index < self._generation_from:
            candidate = replace(candidate, late=True)
        if not candidate.step:
            (self._extra if candidate.extra else self._evaluated).append((candidate, loss))
        return candidate

    def new_index(self) -> int:
        """New index, of a candidate that was never drawn: no other has it."""
        self.drawn += 1
        return self.drawn - 1

    def withdraw(self, x: Float64) -> None:
        """Say that x (d,) will not be told; if it is not pending, nothing happens."""
        candidate = self.take(x)
        if candidate is not None and not (candidate.extra or candidate.step):
            self._withdrawn += candidate.index >= self._generation_from

    def is_pending(self, x: Float64) -> bool:
        """Whether x (d,) was handed out and not yet told."""
        return bool(self._pending.get(_key(x)))

    def take(self, x: Float64) -> Candidate | None:
        """Take x (d,) from the pending candidates; returns it, or None if it is not pending."""
        key = _key(x)
        if not (waiting := self._pending.get(key)):
            return None
        likeness = [(not np.array_equal(one.x, x), not one.extra) for one in waiting]
        return self._pop(key, likeness.index(min(likeness)))

    def _pop(self, key: bytes, which: int) -> Candidate:
        candidate = self._pending[key].pop(which)
        self._n_pending -= 1
        if not self._pending[key]:
            del self._pending[key]
        return candidate

    @property
    def evaluated(self) -> int:
        """Candidates of the present generation that were told."""
        return len(self._evaluated)

    @property
    def missing(self) -> int:
        """Candidates that the present generation lacks, be they out, withdrawn or lost."""
        return self.size - len(self._evaluated) - min(len(self._extra), self._withdrawn)

    def members(self) -> tuple[list[Candidate], Float64]:
        """Those in the order in which they were asked, and their losses (n,)."""
        counted = self._evaluated or self._extra  # extra ones if no other ever came back
        ordered = sorted(counted, key=lambda pair: pair[0].index)
        losses = np.array([loss for _, loss in ordered], np.float64)
        return [candidate for candidate, _ in ordered], losses

    @property
    def complete(self) -> bool:
        """Whether a whole generation has been told, or what is missing is lost."""
        if not self.size or self.missing <= 0:
            return self.size > 0
        extra = len(self._extra)
        return extra > 0 and extra >= _LOST * max(self.size, self.awaited)

    def close_generation(self) -> tuple[list[Candidate], Float64]:
        """Members of the generation and their losses (n,), see `members`.

        What was drawn for the generation and never handed out is thrown away.
        """
        members, losses = self.members()
        self._evaluated, self._extra, self._withdrawn = [], [], 0
        self._queue.clear()
        self._unmade = np.empty((0, 0))
        self._generation_from, self._lags = self.drawn, (0, self._lags[0])
        self.generations += 1
        return members, losses

    def forget_pending(self) -> None:
        """A restart: what is still pending counts as injected if it is told."""
        self._pending.clear()
        self._n_pending = 0

    # -- saving ------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Everything, as arrays, but what makes proposals."""
        self.settle()
        waiting = [c for several in self._pending.values() for c in several]
        return {
            "size": self.size,
            "drawn": self.drawn,
            "generations": self.generations,
            "generation_from": self._generation_from,
            "most_pending": self._most_pending,
            "unmade": self._unmade,
            "unmade_from": self._unmade_from,
            "queue": pack(list(self._queue)),
            "pending": pack(sorted(waiting, key=lambda c: c.index)),
            "evaluated": pack([c for c, _ in self._evaluated]),
            "losses": np.array([loss for _, loss in self._evaluated], np.float64),
            "extra": pack([c for c, _ in self._extra]),
            "extra_losses": np.array([loss for _, loss in self._extra], np.float64),
            "withdrawn": self._withdrawn,
            "newest": self._newest,
            "lags": list(self._lags),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any], dim: int) -> Population:
        """Population of points (dim,) as it was when `state_dict` was taken; ValueError if none."""
        check(state, _SCHEMA, {"d": dim}, "population")
        population = cls()
        population.size = state["size"]
        population.drawn = state["drawn"]
        population.generations = state["generations"]
        population._generation_from = state["generation_from"]
        population._most_pending = state["most_pending"]
        population._unmade, population._unmade_from = state["unmade"], state["unmade_from"]
        population._queue.extend(unpack(state["queue"]))
        for candidate in unpack(state["pending"]):
            population._await(candidate)
        for told, name, losses in (
            (population._evaluated, "evaluated", "losses"),
            (population._extra, "extra", "extra_losses"),
        ):
            told.extend(zip(unpack(state[name]), state[losses].tolist(), strict=True))
        population._withdrawn, population._newest = state["withdrawn"], state["newest"]
        population._lags = (*state["lags"],)
        return population


def search_columns(members: list[Candidate]) -> tuple[Float64, Mask]:
    """What the search distribution learns from: z (n, d), and which it did not draw, (n,)."""
    z = np.array([candidate.z for candidate in members])
    return z, np.array([candidate.proposed or candidate.late for candidate in members])


def mirrored_pair(members: list[Candidate]) -> tuple[int, int] | None:
    """Where among members, sorted by index, the first whole mirrored pair is; None without.

    A late one does not count: it lies along an earlier step of the mean.
    """
    for i, (one, other) in enumerate(pairwise(members)):
        is_pair = one.mirrored and other.mirrored and other.index == one.index + 1
        if is_pair and not one.late and not other.late:
            return i, i + 1
    return None


def _key(x: Float64) -> bytes:
    """Name of a point, the same after a way through a renderer in single precision."""
    return (x.astype(np.float32) + np.float32(0.0)).tobytes()  # 0 and -0 are one number


_SCHEMA: Schema = {
    "size": whole(),
    "drawn": whole(),
    "generations": whole(),
    "generation_from": whole(),
    "most_pending": whole(),
    "unmade": array("unmade", "d", low=-1e60, high=1e60),
    "unmade_from": whole(),
    "queue": form_of("queued"),
    "pending": form_of("pending"),
    "evaluated": form_of("evaluated"),
    "losses": array("evaluated", high=np.inf),
    "extra": form_of("extra"),
    "extra_losses": array("extra", high=np.inf),
    "withdrawn": whole(),
    "newest": whole(),
    "lags": row(whole(), whole()),
}
