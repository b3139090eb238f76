"""A candidate, and how a list of them is saved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from fide_plugins.runtime.schema import Schema, array
from fide_plugins.types import Float64

__all__ = ["Candidate", "form_of", "pack", "unpack"]


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A point of the cube on its way to the user and back.

    index: its number among all candidates ever drawn.
    x: (d,), what is rendered.
    z: (d,), what the search distribution learns from; into(z) = x.
    proposed: whether a proposer made it, and not the search distribution.
    late: whether it was told after its own generation was complete.
    mirrored: whether it is one of the pair that measures the step size, see `search.step_size`.
    extra: whether its generation does not need it.
    step: whether it came between two generations, and is of none, see `proposers.steps`.
    """

    index: int
    x: Float64
    z: Float64
    proposed: bool = False
    late: bool = False
    mirrored: bool = False
    extra: bool = False
    step: bool = False


_FLAGS = tuple(field.name for field in fields(Candidate) if field.default is False)


def pack(candidates: list[Candidate]) -> dict[str, Any]:
    """Arrays of all fields, each (n, ...)."""
    return {
        "index": np.array([c.index for c in candidates], np.int64),
        "x": np.array([c.x for c in candidates]),
        "z": np.array([c.z for c in candidates]),
        **{name: np.array([getattr(c, name) for c in candidates], bool) for name in _FLAGS},
    }


def unpack(packed: Mapping[str, Any]) -> list[Candidate]:
    """Candidates that `pack` was given."""
    flags = [packed[name].tolist() for name in _FLAGS]
    columns = (packed["index"].tolist(), packed["x"], packed["z"], *flags)
    return [Candidate(i, x.copy(), z.copy(), *f) for i, x, z, *f in zip(*columns, strict=True)]


def form_of(n: str) -> Schema:
    """Return the form of what `pack` gives for n candidates."""
    return {
        "index": array(n, kind="i"),
        "x": array(n, "d", low=0.0, high=1.0),
        "z": array(n, "d", low=-1e60, high=1e60),
        **{name: array(n, kind="b") for name in _FLAGS},
    }
