"""A candidate, what it counts for, and how a list of them is saved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from fide_plugins.runtime.schema import Schema, array
from fide_plugins.types import Float64

__all__ = ["Candidate", "CandidateRole", "form_of", "pack", "unpack"]


class CandidateRole(IntEnum):
    """What a candidate counts for.

    ======  ====================================  ===========  ===============================
    role    counts towards a generation           waited for   if it is withdrawn
    ======  ====================================  ===========  ===============================
    MEMBER  that in which it is told              yes          a spare one counts in its place
    SPARE   for members that do not come back     yes          nothing happens
    STEP    no                                    no           nothing happens
    ======  ====================================  ===========  ===============================

    A spare one is asked beyond a generation that needs just its own candidates, such as a test.  A
    step comes between two generations (`proposers.steps`).  A point that is told and was not
    pending is no candidate: it is *injected*.
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
    mirrored: whether it is one of the pair that measures the step size, see `search.step_size`.
    """

    index: int
    x: Float64
    z: Float64
    role: CandidateRole = CandidateRole.MEMBER
    proposed: bool = False
    off_distribution: bool = False
    mirrored: bool = False


_FLAGS = ("proposed", "off_distribution", "mirrored")


def pack(candidates: list[Candidate]) -> dict[str, Any]:
    """Arrays of all fields, each (n, ...); roles are "kind", as in earlier checkpoints."""
    return {
        "index": np.array([c.index for c in candidates], np.int64),
        "x": np.array([c.x for c in candidates]),
        "z": np.array([c.z for c in candidates]),
        "kind": np.array([c.role for c in candidates], np.int64),
        **{name: np.array([getattr(c, name) for c in candidates], bool) for name in _FLAGS},
    }


def unpack(packed: Mapping[str, Any]) -> list[Candidate]:
    """Candidates that `pack` was given."""
    roles = [CandidateRole(role) for role in packed["kind"].tolist()]
    flags = [packed[name].tolist() for name in _FLAGS]
    columns = (packed["index"].tolist(), packed["x"], packed["z"], roles, *flags)
    return [Candidate(i, x.copy(), z.copy(), *f) for i, x, z, *f in zip(*columns, strict=True)]


def form_of(n: str) -> Schema:
    """Return the form of what `pack` gives for n candidates."""
    return {
        "index": array(n, kind="i"),
        "x": array(n, "d", low=0.0, high=1.0),
        "z": array(n, "d", low=-1e60, high=1e60),
        "kind": array(n, kind="i", low=min(CandidateRole), high=max(CandidateRole)),
        **{name: array(n, kind="b") for name in _FLAGS},
    }
