"""Schema of the state of a `Record`, see `runtime.schema`.

The state of `Fidelity`, which renders with few samples per pixel at first, is part of it.

Sides: e evaluations, m improvements, k of them with their points, g generations, p pending
candidates, d parameters, H x W pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from fide_plugins.recording.record import PARTS
from fide_plugins.runtime.schema import Schema, array, check, maybe, real, table, whole

__all__ = ["check_record"]

_IMAGE = maybe(array("H", "W", 3, low=0.0, high=1.0))
_FIDELITY: Schema = {
    "rule": {
        "number": whole(1),
        "since": whole(),
        "halves": array("pairs", low=0.0),
        "spreads": array("spreads", low=0.0),
    },
    "level": whole(),
    "total": whole(),
}
_RECORD: Schema = {
    "losses": array("e", low=None),
    "seconds": array("e", low=0.0),
    "improvements": array("m", kind="i", low=0.0),
    "path": array("k", "d", low=0.0, high=1.0),
    "metrics": table(array("m", low=None)),
    "generations": array("g", kind="i", low=0.0, high=2.0**40),
    "times": dict.fromkeys(PARTS, real()),
    "wall_s": real(),
    "watch_s": real(),
    "best_loss": real(high=math.inf),
    "best_evaluation": whole(-1),
    "x_best": maybe(array("d", low=0.0, high=1.0)),
    "image": _IMAGE,
    "first_image": _IMAGE,
    "pending": maybe(array("p", "d", low=0.0, high=1.0)),
    "fidelity": maybe(_FIDELITY),
    "failures": whole(),
}


def check_record(state: Any, dim: int, size: Sequence[int]) -> None:
    """Raise ValueError unless `state` is valid for a run of `dim` parameters and size (H, W)."""
    sides = {"d": dim, "H": size[0], "W": size[1]}
    check(state, _RECORD, sides, "record")
    asked, evaluations = int(state["generations"].sum()), sides["e"]
    if asked != evaluations + sides.get("p", 0):
        raise ValueError(f"of {asked} candidates asked, {evaluations} were evaluated")
    if sides["m"] and int(state["improvements"].max()) >= evaluations:
        raise ValueError(f"an improvement after all {evaluations} evaluations")
