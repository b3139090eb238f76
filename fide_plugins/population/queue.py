"""Candidates that were drawn and not yet handed out: samples, and after them proposals.

Proposals are made when they are asked for, from all that was told by then: those that are asked
together by one call, or all of them when the first one is.  Until then there are only the samples
of which they will be made.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np

from fide_plugins.population.candidate import Candidate, CandidateRole, form_of, pack, unpack
from fide_plugins.runtime.schema import Schema, array, whole
from fide_plugins.types import Float64, Mask

__all__ = ["SCHEMA", "Propose", "Queue"]

Propose: TypeAlias = Callable[[Float64], tuple[Float64, Float64]]
"""From samples (m, d): x and z of proposals, (m, d) each."""

SCHEMA: Schema = {
    "made": form_of("queued"),
    "unmade": array("unmade", "d", low=-1e60, high=1e60),
    "unmade_from": whole(),
}


class Queue:
    """Candidates in the order in which they will be handed out."""

    def __init__(self) -> None:
        self._made: deque[Candidate] = deque()
        self._unmade: Float64 = np.empty((0, 0))  # (m, d), samples for the proposals that follow
        self._unmade_from = 0  # index of the first of these
        self._propose: Propose | None = None  # makes them
        self._singly = False  # each when it is asked for

    def __len__(self) -> int:
        return len(self._made) + len(self._unmade)

    @property
    def unmade(self) -> int:
        """How many are proposals that are not made yet."""
        return len(self._unmade)

    @property
    def ready(self) -> int:
        """How many wait for nothing; all of them if none is made."""
        return len(self) if self._singly else len(self._made) or len(self._unmade)

    def draw(
        self,
        index: int,
        x: Float64,
        z: Float64,
        unmade: Float64,
        role: CandidateRole,
        *,
        pair: bool,
    ) -> None:
        """Add candidates x (n, d) with their z (n, d), and proposals of samples `unmade` (m, d).

        index: of the first of them.  pair: whether the first two are a mirrored pair.
        """
        pair = pair and len(x) >= 2
        for i, (point, drawn) in enumerate(zip(x, z, strict=True)):
            self._made.append(Candidate(index + i, point, drawn, role, mirrored=pair and i < 2))
        self._unmade, self._unmade_from = unmade, index + len(x)

    def propose_by(self, propose: Propose, *, singly: bool) -> None:
        """Say what makes the proposals, and whether each is made when it is asked for."""
        self._propose, self._singly = propose, singly

    def make(self, n: int | None = None) -> None:
        """Make proposals until n candidates are made; all if n is None, or if not `singly`.

        If that raises, the next call tries again.
        """
        if not len(self._unmade) or (n is not None and n <= len(self._made)):
            return
        assert self._propose is not None
        m = len(self._unmade) if n is None or not self._singly else n - len(self._made)
        made = list(zip(*self._propose(self._unmade[:m]), strict=True))
        for x, z in made:
            self._made.append(Candidate(self._next_unmade(), x, z, proposed=True))

    def settle(self) -> None:
        """Make the proposals that no further result can change."""
        if not self._singly:
            self.make()

    def pop(self) -> Candidate:
        """The next one."""
        self.make(1)
        return self._made.popleft()

    def proposed(self, first: int, n: int) -> Mask:
        """Which of n candidates, from the first on, are proposals, (n,)."""
        flags = [candidate.proposed for candidate in self._made] + [True] * len(self._unmade)
        return np.array(flags[first : first + n], bool)

    def replace(self, first: int, x: Float64, z: Float64, proposed: Mask) -> None:
        """Put others in the place of candidates, see `Population.replace`."""
        for i, (point, drawn, made) in enumerate(zip(x, z, proposed, strict=True), first):
            is_made = i < len(self._made)  # or the next proposal, which then never is
            index = self._made[i].index if is_made else self._next_unmade()
            other = Candidate(index, point, drawn, proposed=bool(made), off_distribution=True)
            if is_made:
                self._made[i] = other
            else:
                self._made.append(other)

    def _next_unmade(self) -> int:
        """Index of the next proposal that is not made, which is taken off these."""
        self._unmade, self._unmade_from = self._unmade[1:], self._unmade_from + 1
        return self._unmade_from - 1

    def clear(self) -> None:
        """Throw all away."""
        self._made.clear()
        self._unmade = np.empty((0, 0))

    def state_dict(self) -> dict[str, Any]:
        """Everything, as arrays, but what makes proposals."""
        self.settle()
        made = pack(list(self._made))
        return {"made": made, "unmade": self._unmade, "unmade_from": self._unmade_from}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Queue:
        """Undo `state_dict`, whose form is `SCHEMA`."""
        queue = cls()
        queue._made.extend(unpack(state["made"]))
        queue._unmade, queue._unmade_from = state["unmade"], state["unmade_from"]
        return queue
