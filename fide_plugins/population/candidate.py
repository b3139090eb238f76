"""A candidate, what it counts for, and what is remembered of it once it is evaluated."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from operator import attrgetter
from typing import Any

import numpy as np
from torch import Tensor, as_tensor, device, stack

from fide_plugins.runtime.schema import (
    Schema,
    Sides,
    array,
    check,
    form,
    maybe,
    real,
    saved,
    values,
    whole,
)
from fide_plugins.types import Float64, Solution


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

    index: int
    x: Float64
    z: Float64
    role: CandidateRole = CandidateRole.MEMBER
    proposed: bool = False
    off_distribution: bool = False
    mirrored: bool = False


_COLUMNS = {
    "index": np.int64, "x": np.float64, "z": np.float64, "role": np.int64,
    "proposed": np.bool_, "off_distribution": np.bool_, "mirrored": np.bool_,
}  # fmt: skip


def pack(candidates: Iterable[Candidate]) -> dict[str, Any]:
    """Arrays of all fields, each (n, ...)."""
    every = list(candidates)
    return {name: np.array([getattr(c, name) for c in every], t) for name, t in _COLUMNS.items()}


def unpack(packed: Mapping[str, Any]) -> list[Candidate]:
    """Candidates that `pack` was given."""
    return [
        Candidate(int(index), x.copy(), z.copy(), CandidateRole(role), *map(bool, flags))
        for index, x, z, role, *flags in zip(*(packed[name] for name in _COLUMNS), strict=True)
    ]


def form_of(n: str) -> Schema:
    """Return the form of what `pack` gives for n candidates."""
    return {
        "index": array(n, kind="i"),
        "x": array(n, "d", low=0.0, high=1.0),
        "z": array(n, "d", low=-1e60, high=1e60),
        "role": array(n, kind="i", low=min(CandidateRole), high=max(CandidateRole)),
        **{name: array(n, kind="b") for name, kind in _COLUMNS.items() if kind is np.bool_},
    }


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
    tokens: Tensor = saved(array("T", "C"))
    loss: float = saved(real())
    evaluation: int = saved(whole())

    def state_dict(self) -> dict[str, Any]:
        """All of it; tokens are those in use, not a copy."""
        return values(self)

    @classmethod
    def from_state(cls, state: Mapping[str, Any], device: device | None = None) -> TrainingSample:
        """Undo `state_dict`; arrays serve as tensors, which go to the device."""
        return cls(**{**state, "tokens": as_tensor(state["tokens"], device=device)})


def columns(samples: Sequence[TrainingSample]) -> tuple[Float64, Tensor, Float64]:
    """Of samples, at least one: x (n, d), tokens (n, T, C), losses (n,)."""
    x = np.array([sample.x for sample in samples])
    losses = np.array([sample.loss for sample in samples])
    return x, stack([sample.tokens for sample in samples]), losses


def in_order(samples: Iterable[TrainingSample]) -> list[TrainingSample]:
    """Samples in the order in which they were asked, whatever that in which they were told."""
    return sorted(samples, key=attrgetter("index"))


@dataclass(frozen=True, slots=True)
class Best:
    """The best point told so far.

    solution: the point.
    index: number of its candidate.
    mean: (d,), mean of the search that asked it; the point itself if none did.
    search_number: of the search that asked it; 0 for none.
    """

    solution: Solution
    index: int = saved(whole())
    mean: Float64 = saved(array("d", low=-1e60, high=1e60))
    search_number: int = saved(whole())

    def state_dict(self) -> dict[str, Any]:
        """All of it but what is computed when it is read; arrays are those in use, not copies."""
        return values(self) | {name: getattr(self.solution, name) for name in _SOLUTION}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Best:
        """Undo `state_dict`."""
        solution = Solution(**{name: state[name] for name in _SOLUTION})
        return cls(solution, **{name: state[name] for name in form(cls)})

    @classmethod
    def schema(cls) -> Schema:
        """Return the form of what `state_dict` gives."""
        return form(cls) | _SOLUTION


_SOLUTION: dict[str, Schema] = {
    "x": array("d", low=0.0, high=1.0),
    "loss": real(),
    "evaluation": whole(),
    "image": maybe(array("H", "W", 3, low=0.0, high=1.0)),
}


# -- what is remembered for later pictures, and for `Solution.std` ---------------------------------

_MEGABYTE = 2**20
_LEAST = 4096  # bytes of a sample; its objects take about as much, however few numbers they hold
_PACKED: Schema = {
    "index": array("n", kind="i", low=0),
    "x": array("n", "d", low=0.0, high=1.0),
    "tokens": array("n", "T", "C"),
    "losses": array("n"),
    "evaluation": array("n", kind="i", low=0),
}
_MEMORY: Schema = {
    "earlier": maybe(_PACKED),
    "latest": maybe(_PACKED),
    "left": whole(),
    "stride": whole(1),
}


class Memory:
    """Samples of a run, at most `megabytes` of tokens and parameters; 0: none.

    Half of the room is for the latest samples.  The other half is for every s-th of those that have
    left the first, where s doubles whenever the room is full: they are spread evenly over the run.
    """

    def __init__(self, megabytes: float) -> None:
        self._bytes = megabytes * _MEGABYTE
        self._latest: deque[TrainingSample] = deque()
        self._earlier: list[TrainingSample] = []
        self._left = 0  # samples that have left the first half
        self._stride = 1  # s

    @property
    def samples(self) -> list[TrainingSample]:
        """All of them, the earliest first."""
        return [*self._earlier, *self._latest]

    def add(self, sample: TrainingSample) -> None:
        """Remember a sample; others may be forgotten for it."""
        each = max(_LEAST, sample.tokens.nbytes + sample.x.nbytes)
        room = int(min(self._bytes / each, sys.maxsize))  # there may be no limit
        if room < 2:
            return
        self._latest.append(sample)
        if len(self._latest) <= room // 2:
            return
        sample, self._left = self._latest.popleft(), self._left + 1
        if self._left % self._stride == 0:
            self._earlier.append(sample)
        if len(self._earlier) > room - room // 2:
            self._earlier = self._earlier[1::2]
            self._stride *= 2

    def set_losses(self, losses: Sequence[float]) -> None:
        """Give all samples, in the order of `samples`, the losses (n,) of another target."""
        every = [replace(one, loss=x) for one, x in zip(self.samples, losses, strict=True)]
        self._earlier = every[: len(self._earlier)]
        self._latest = deque(every[len(self._earlier) :])

    def state_dict(self) -> dict[str, Any]:
        """Everything, as arrays."""
        earlier, latest = _pack(self._earlier), _pack(list(self._latest))
        return {"earlier": earlier, "latest": latest, "left": self._left, "stride": self._stride}

    def load_state_dict(self, state: Mapping[str, Any], sides: Sides, device: device) -> None:
        """Put back what `state_dict` gave, tokens on the device; ValueError if it is none.

        sides: d, T and C, by these names.
        """
        for half in ("earlier", "latest"):  # of different lengths n
            check({**state, "earlier": None, "latest": state[half]}, _MEMORY, dict(sides), "memory")
        self._earlier = _unpack(state["earlier"], device)
        self._latest = deque(_unpack(state["latest"], device))
        self._left, self._stride = state["left"], state["stride"]


def _pack(samples: list[TrainingSample]) -> dict[str, Any] | None:
    if not samples:
        return None
    x, tokens, losses = columns(samples)
    numbers = {
        name: np.array([getattr(sample, name) for sample in samples], np.int64)
        for name in ("index", "evaluation")
    }
    return {"x": x, "tokens": tokens, "losses": losses, **numbers}


def _unpack(packed: Mapping[str, Any] | None, device: device) -> list[TrainingSample]:
    if packed is None:
        return []
    tokens: list[Tensor] = [as_tensor(one, device=device).clone() for one in packed["tokens"]]
    x = [one.copy() for one in packed["x"]]
    index, losses, told = (packed[name].tolist() for name in ("index", "losses", "evaluation"))
    return [TrainingSample(*one) for one in zip(index, x, tokens, losses, told, strict=True)]
