"""A candidate whose image is known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor, as_tensor, device

from fide_plugins.points import Float64

__all__ = ["Rendered"]


@dataclass(frozen=True, slots=True, eq=False)
class Rendered:
    """What the features of one image are learned from.

    index: order of asking.
    x: (d,), parameters.
    tokens: (T, C), features of the image.
    loss: finite.
    """

    index: int
    x: Float64
    tokens: Tensor
    loss: float

    @classmethod
    def from_state(cls, state: Mapping[str, Any], device: device | None = None) -> Rendered:
        """Undo `dataclasses.asdict`; arrays serve as tensors, which go to the device."""
        return cls(**{**state, "tokens": as_tensor(state["tokens"], device=device)})
