"""The record of candidates: which were drawn, which are pending, which were evaluated.

FIDE and all baselines keep one.  A candidate is drawn (`queue`), handed out (`pending`) and told;
users tell in whatever order and pieces.

*What counts.*  A `CandidateRole` says what a candidate counts for.  Asking for more than is left of
a generation draws more members from the same distribution, and any of them complete it.  Those that
are told after that count in the next one, in which they are `off_distribution`.  Where a generation
needs just its own candidates, for a test, asking for more draws spare ones.  A point that was asked
before a restart, told twice, or never asked at all is *injected*: it tells about the renderer, not
about the search distribution.

*When a generation is complete.*  It lacks

    missing = size - members told - min(members withdrawn, spare ones told)

and is complete when that is 0.  If members are lost, that never happens.  So it is complete, too,
when twice as many spare ones were told as it has members, and twice as many as are still *awaited*:
pending and not much later than all others.

Members are then sorted in the order in which they were asked, so that the result does not depend
on the order of telling.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from fide_plugins.population.candidate import Candidate, CandidateRole, form_of, pack, unpack
from fide_plugins.population.pending import SCHEMA as PENDING, Pending
from fide_plugins.population.queue import SCHEMA as QUEUE, Propose, Queue
from fide_plugins.runtime.schema import Schema, array, check, whole
from fide_plugins.types import Float64, Mask

__all__ = ["Population", "mirrored_pair", "search_columns"]

_LOST = 2  # generations' worth of spare candidates told, after which members count as lost


class Population:
    """Candidates drawn, pending and evaluated."""

    def __init__(self) -> None:
        self.size = 0
        """Members of the present generation."""
        self.drawn = 0
        """Candidates ever drawn."""
        self.generations = 0
        """Generations completed."""
        self._queue = Queue()  # drawn, not handed out
        self._pending = Pending()  # handed out, not told
        self._members: list[tuple[Candidate, float]] = []  # told in the present generation
        self._spare: list[tuple[Candidate, float]] = []  # told, too, and not needed by it
        self._withdrawn = 0  # of its own candidates, in whose place spare ones count
        self._generation_from = 0  # candidates of a lower index belong to an earlier generation

    # -- asking ------------------------------------------------------------------------------------

    @property
    def remaining(self) -> int:
        """Candidates of this generation that were drawn and not yet handed out."""
        return len(self._queue)

    @property
    def ready(self) -> int:
        """How many of these wait for nothing; all that remain if none is made."""
        return self._queue.ready

    @property
    def unmade(self) -> int:
        """How many of these are proposals that are not made yet."""
        return self._queue.unmade

    @property
    def has_begun(self) -> bool:
        """Whether something of the present generation is out, told or withdrawn."""
        return self.pending + self.evaluated + self._withdrawn > 0

    def draw(
        self,
        x: Float64,
        z: Float64,
        unmade: Float64 | None = None,
        *,
        pair: bool = False,
        spare: bool = False,
    ) -> None:
        """Queue candidates x (n, d) with their z (n, d) as a generation.

        unmade: samples (m, d), from which the proposals that follow are made, see `propose_by`.
        pair: whether the first two are a mirrored pair.
        spare: whether the present generation needs none of x.
        """
        unmade = np.empty((0, 0)) if unmade is None else unmade
        n = len(x) + len(unmade)
        if not spare:
            self.size, self._withdrawn = n, 0
        role = CandidateRole.SPARE if spare else CandidateRole.MEMBER
        self._queue.draw(self.drawn, x, z, unmade, role, pair=pair)
        self.drawn += n

    def propose_by(self, propose: Propose, *, singly: bool) -> None:
        """Say what makes the proposals; a checkpoint cannot hold it.

        singly: each proposal when it is asked for, otherwise all when the first one is.  Those that
            are asked for together are made by one call of `propose`.
        """
        self._queue.propose_by(propose, singly=singly)

    def make_proposals(self, n: int | None = None) -> None:
        """Make proposals until n candidates are queued; all if n is None, or if not `singly`.

        If that raises, the next call tries again.
        """
        self._queue.make(n)

    def settle(self) -> None:
        """Make the proposals that no further result can change."""
        self._queue.settle()

    def proposed(self, first: int, n: int) -> Mask:
        """Which of n candidates of those that remain are proposals, (n,), from the first on."""
        return self._queue.proposed(first, n)

    def replace(self, first: int, x: Float64, z: Float64, proposed: Mask) -> None:
        """Put points x (m, d) of another distribution, with their z (m, d), in candidates' place.

        first: of those that remain, which is queued, or the next proposal.
        proposed: (m,), whether each is a proposal.
        """
        self._queue.replace(first, x, z, proposed)

    def expect(self, n: int) -> None:
        """Prepare for n candidates that are asked at once: all of them may be pending."""
        self._pending.expect(max(n, self.size))

    def hand_out(self) -> Candidate:
        """Next candidate of the generation."""
        candidate = self._queue.pop()
        self._pending.add(candidate)
        return candidate

    def hand_out_all(self) -> list[Candidate]:
        """All candidates of the generation that remain."""
        self.expect(self.remaining)
        self.make_proposals()
        return [self.hand_out() for _ in range(self.remaining)]

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
        index = self.new_index()
        self._pending.add(Candidate(index, x, z, role, proposed, off_distribution))

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
        """Those of the pending for which a generation waits, see `Pending.awaited`."""
        return self._pending.awaited(self.size)

    def is_pending(self, x: Float64) -> bool:
        """Whether x (d,) was handed out and not yet told."""
        return x in self._pending

    def take(self, x: Float64) -> Candidate | None:
        """Take x (d,) from the pending candidates; returns it, or None if it is not pending."""
        return self._pending.take(x)

    def withdraw(self, x: Float64) -> None:
        """Say that x (d,) will not be told; if it is not pending, nothing happens."""
        candidate = self.take(x)
        if candidate is not None and candidate.role is CandidateRole.MEMBER:
            self._withdrawn += candidate.index >= self._generation_from

    def forget_pending(self) -> None:
        """A restart: what is still pending counts as injected if it is told."""
        self._pending.clear()

    # -- telling -----------------------------------------------------------------------------------

    def record(self, x: Float64, loss: float) -> Candidate | None:
        """Enter the loss of x (d,); returns the candidate as it counts, or None: injected."""
        candidate = self.take(x)
        if candidate is None:
            return None
        self._pending.note_result(candidate, self.size)
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
        return self.size > 0 and (self.missing <= 0 or self._is_lost)

    @property
    def _is_lost(self) -> bool:
        """Whether so many spare ones were told that what is missing will not come any more."""
        told = len(self._spare)
        return told >= _LOST * self.size and told >= _LOST * self.awaited

    def members(self) -> tuple[list[Candidate], Float64]:
        """Those told in the order in which they were asked, and their losses (n,).

        Spare ones if no other ever came back.
        """
        ordered = sorted(self._members or self._spare, key=lambda pair: pair[0].index)
        losses = np.array([loss for _, loss in ordered], np.float64)
        return [candidate for candidate, _ in ordered], losses

    def close_generation(self) -> tuple[list[Candidate], Float64]:
        """Members of the generation and their losses (n,), see `members`.

        What was drawn for the generation and never handed out is thrown away.
        """
        members, losses = self.members()
        self._members, self._spare, self._withdrawn = [], [], 0
        self._queue.clear()
        self._pending.begin_generation()
        self._generation_from = self.drawn
        self.generations += 1
        return members, losses

    # -- saving ------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Everything, as arrays, but what makes proposals."""
        return {
            "size": self.size,
            "drawn": self.drawn,
            "generations": self.generations,
            "generation_from": self._generation_from,
            "withdrawn": self._withdrawn,
            "queue": self._queue.state_dict(),
            "pending": self._pending.state_dict(),
            "members": pack([c for c, _ in self._members]),
            "losses": np.array([loss for _, loss in self._members], np.float64),
            "spare": pack([c for c, _ in self._spare]),
            "spare_losses": np.array([loss for _, loss in self._spare], np.float64),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any], dim: int) -> Population:
        """Population of points (dim,) as it was when `state_dict` was taken; ValueError if none."""
        check(state, _SCHEMA, {"d": dim}, "population")
        population = cls()
        population.size, population.drawn = state["size"], state["drawn"]
        population.generations = state["generations"]
        population._generation_from = state["generation_from"]
        population._withdrawn = state["withdrawn"]
        population._queue = Queue.from_state(state["queue"])
        population._pending = Pending.from_state(state["pending"])
        population._members = _told(state["members"], state["losses"])
        population._spare = _told(state["spare"], state["spare_losses"])
        return population


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


def _told(packed: Mapping[str, Any], losses: Float64) -> list[tuple[Candidate, float]]:
    return list(zip(unpack(packed), losses.tolist(), strict=True))


_SCHEMA: Schema = {
    "size": whole(),
    "drawn": whole(),
    "generations": whole(),
    "generation_from": whole(),
    "withdrawn": whole(),
    "queue": QUEUE,
    "pending": PENDING,
    "members": form_of("members"),
    "losses": array("members", high=np.inf),
    "spare": form_of("spare"),
    "spare_losses": array("spare", high=np.inf),
}
