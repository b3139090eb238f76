"""Parameters and tokens of what was rendered, for later pictures and for `Solution.std`."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from torch import Tensor, as_tensor, device

from fide_plugins.population.candidate import TrainingSample, columns
from fide_plugins.runtime.schema import Schema, Sides, array, check, maybe, whole

_MEGABYTE = 2**20
_LEAST = 4096  # bytes of a sample; its objects take about as much, however few numbers they hold
_PACKED: Schema = {
    "index": array("n", kind="i", low=0),
    "x": array("n", "d", low=0.0, high=1.0),
    "tokens": array("n", "T", "C"),
    "losses": array("n"),
    "evaluation": array("n", kind="i", low=0),
}
_SCHEMA: Schema = {
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
        if len(self._latest) > room // 2:
            self._leave(self._latest.popleft(), room - room // 2)

    def _leave(self, sample: TrainingSample, room: int) -> None:
        self._left += 1
        if self._left % self._stride == 0:
            self._earlier.append(sample)
        if len(self._earlier) > room:
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
            check({**state, "earlier": None, "latest": state[half]}, _SCHEMA, dict(sides), "memory")
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
