"""A candidate whose image is known: what proposers and moves learn from."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor, as_tensor, device

from fide_plugins.runtime.devices import stack
from fide_plugins.runtime.schema import Schema, array, real, whole
from fide_plugins.types import Float64

__all__ = ["SCHEMA", "TrainingSample", "columns", "in_order"]

SCHEMA: dict[str, Schema] = {
    "index": whole(),
    "x": array("d", low=0.0, high=1.0),
    "tokens": array("T", "C"),
    "loss": real(),
    "evaluation": whole(),
}


@dataclass(frozen=True, slots=True, eq=False)
class TrainingSample:
    """One evaluation whose image is known.

    index: order of asking.
    x: (d,), parameters.
    tokens: (T, C), features of the image.
    loss: finite.
    evaluation: number of the evaluation, from 0, in the order of telling.
    """

    index: int
    x: Float64
    tokens: Tensor
    loss: float
    evaluation: int

    def state_dict(self) -> dict[str, Any]:
        """All of it; tokens are those in use, not a copy."""
        return {name: getattr(self, name) for name in SCHEMA}

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
    return sorted(samples, key=lambda sample: sample.index)
