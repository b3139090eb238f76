"""One optimizer in many processes: each keeps a replica, and all are told the same in one order.

Nothing is shared but the *log*, which somebody keeps (a database, say): points with their losses
and features, in an order on which all agree.  An optimizer is a function of its seed and of what it
was told, so replicas that were told the same log propose the same candidates, and

- a candidate has a name, (generation, slot), that means the same to everybody: who knows that slots
  0 to 4 are out may take slot 5 without asking anybody;
- slots have no end: those beyond the generation's size are drawn from the same distribution, by a
  generator made from (seed, generation, slot), so that drawing them changes nothing; as soon as
  half of the generation is known, who asks for one is better off with the `newest`, though;
- who comes later, or was away, catches up by being told the log; nothing is rendered again.

Rounding that differs from machine to machine, or features that are not known to all their digits
everywhere, may change a candidate a little; it is then told as what was rendered.  They must not
change *when a search is over*, which decides what the next generation is for and how large it is:
whoever asks in a generation says in which one its search `began`, and the others follow.

What an entry of the log counts for is its `Role`:

=======  =========================================================================================
member   a candidate of the present generation: as if one optimizer had asked it
foreign  asked in the present generation and yet not the candidate of that name: a parameter was
         fixed by somebody, or another machine rounds otherwise
late     asked in an earlier generation of the present search, or in this one when all of its
         candidates were out
guest    all others: never asked, or asked in an earlier search
=======  =========================================================================================

All but guests count towards the generation in which they arrive, foreign and late ones with their
steps cut to what a sample's may be (`search.cma_es`); guests as in `FIDE.tell`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Any

import numpy as np
from torch import Tensor

from fide_plugins import fide_state
from fide_plugins.ahead import draw_ahead
from fide_plugins.fide import FIDE
from fide_plugins.ledger import Candidate, Ledger
from fide_plugins.points import Float64
from fide_plugins.search import box
from fide_plugins.search.relocate import Stage

__all__ = ["Replica", "Role"]

_ROUNDING = 1e-9  # of a parameter: what is lost on the way through a user's scale and a database


class Role(StrEnum):
    """What an entry of the log counts for."""

    MEMBER = "member"
    FOREIGN = "foreign"
    LATE = "late"
    GUEST = "guest"


class Replica:
    """An optimizer that is told a log, and that nobody else asks or tells.

    snap: what a candidate (d,) becomes before it is rendered, where parameters are whole numbers,
        choices, or of a scale of their own.
    """

    def __init__(self, optimizer: FIDE, snap: Callable[[Float64], Float64] = np.copy) -> None:
        self.optimizer = optimizer
        self._snap = snap
        self.generation = 0
        """Number of the present generation."""
        self.began = 0
        """Generation in which the present search, or its probes or scouts, began."""
        self._batches: dict[int, list[Candidate]] = {}  # of the present generation
        self._taken: set[int] = set()  # slots of the present generation that were told

    @property
    def size(self) -> int:
        """Entries that make the present generation complete."""
        self._open()
        return self.optimizer._ledger.size

    def candidate(self, slot: int) -> Candidate:
        """Candidate of the present generation in that slot, from 0."""
        self._open()
        batch, row = divmod(slot, self.size)
        if batch not in self._batches:
            seed = np.random.SeedSequence(self.optimizer.seed, spawn_key=(self.generation, batch))
            more = Ledger()
            more.draw(*self.optimizer._draw(np.random.default_rng(seed)))
            self._batches[batch] = more.hand_out_all()
        return self._batches[batch][row]

    def newest(self, slot: int, out: int) -> Candidate:
        """Better one than the candidate in that slot, if the generation does not need that.

        out: entries that are still to be told; with these and those told the generation may be
            complete, and then what is asked now is for the next one.

        It is drawn from what is known when it is asked (see `ahead`), so it differs from worker
        to worker, and from one moment to the next.
        """
        if slot >= self.size <= self.optimizer._ledger.told + out:
            key = (self.generation, slot, 1)  # never that of `candidate`
            seed = np.random.SeedSequence(self.optimizer.seed, spawn_key=key)
            ahead = draw_ahead(self.optimizer, np.random.default_rng(seed))
            if ahead is not None:
                return ahead
        return self.candidate(slot)

    def is_candidate(self, slot: int, x: Float64) -> bool:
        """Whether x (d,) is what becomes of the candidate in that slot."""
        return bool(np.abs(self._snap(self.candidate(slot).x) - x).max() <= _ROUNDING)

    def tell(
        self,
        x: Float64,
        loss: float,
        tokens: Tensor | None = None,
        *,
        generation: int | None = None,
        slot: int = 0,
        proposed: bool = False,
        over: bool | None = None,
    ) -> Role:
        """Next entry of the log; says what it counts for.

        x: (d,) in [0, 1], what was rendered.  tokens: (T, C) of its image, if that is known.
        generation, slot: name of the candidate that was asked; None if it was not.
        proposed: whether the one who asked had it from a proposer, should it be unknown here.
        over: whether somebody began a search, probes or scouts after this generation; None: nobody
            has drawn the next one yet.
        Raises as `FIDE.tell`, before anything changes.
        """
        self._open()
        optimizer, ledger = self.optimizer, self.optimizer._ledger
        role, x = self._register(x, generation, slot, proposed)
        stage, drawn = self._stage_of_search(), ledger.generations
        features = None if tokens is None else tokens[None]
        optimizer._decided = over
        optimizer.tell(x[None], losses=np.array([loss]), features=features)
        optimizer._decided = None
        if ledger.generations != drawn:
            self.generation += 1
            self._batches, self._taken = {}, set()
            if self._stage_of_search() != stage:
                self.began = self.generation
        return role

    def _open(self) -> None:
        """Draw the candidates of the generation; what is still out of others is forgotten."""
        if 0 not in self._batches:
            ledger = self.optimizer._ledger
            ledger.close_search()
            self.optimizer._draw_generation()
            self._batches[0] = ledger.hand_out_all()

    def _register(
        self, x: Float64, generation: int | None, slot: int, proposed: bool
    ) -> tuple[Role, Float64]:
        """Make the ledger expect x, unless it is a guest."""
        if generation is None or generation < self.began:
            return Role.GUEST, x
        ledger = self.optimizer._ledger
        is_open = generation == self.generation
        is_known = is_open and self.is_candidate(slot, x)
        if is_known and slot not in self._taken:
            known = self.candidate(slot)
            self._taken.add(slot)
            if slot >= self.size:
                ledger.adopt(known.x, known.z, proposed=known.proposed)
            return Role.MEMBER, known.x
        z = box.near(x, self.optimizer._search.mean)
        ledger.adopt(x, z, proposed=proposed, late=True)
        beyond = is_open and not is_known and slot >= self.size
        return (Role.LATE if generation < self.generation or beyond else Role.FOREIGN), x

    def _stage_of_search(self) -> tuple[Stage, int]:
        return self.optimizer._stage, self.optimizer._searches

    def state_dict(self) -> dict[str, Any]:
        """Everything but the optimizer's settings; arrays are those in use, not copies."""
        return {
            "optimizer": _arrays(fide_state.pack(self.optimizer)),
            "generation": self.generation,
            "began": self.began,
            "batches": self._batches,
            "taken": self._taken,
        }

    @classmethod
    def from_state(
        cls,
        optimizer: FIDE,
        state: Mapping[str, Any],
        snap: Callable[[Float64], Float64] = np.copy,
    ) -> Replica:
        """Go on where `state_dict` was taken, with a new optimizer of the same settings."""
        replica = cls(optimizer, snap)
        fide_state.restore(optimizer, state["optimizer"])
        replica.generation, replica.began = state["generation"], state["began"]
        replica._batches, replica._taken = dict(state["batches"]), set(state["taken"])
        return replica


def _arrays(tree: Any) -> Any:
    """Copy of nested dicts and lists with tensors, on any device, as arrays."""
    if isinstance(tree, dict):
        return {key: _arrays(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_arrays(value) for value in tree]
    return tree.detach().cpu().numpy() if isinstance(tree, Tensor) else tree
