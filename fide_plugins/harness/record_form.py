"""What the state of a `Record` must be like, see `state_form`.

Sides: e evaluations, m of them improvements, p pending, d parameters, H x W pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from fide_plugins.harness.fidelity import FORM
from fide_plugins.harness.record import PARTS
from fide_plugins.state_form import Form, array, check, maybe, real, table, whole

__all__ = ["check_record"]

_IMAGE = maybe(array("H", "W", 3, low=0.0, high=1.0))
_RECORD: Form = {
    "losses": array("e", low=None),
    "seconds": array("e", low=0.0),
    "improvements": array("m", kind="i", low=0.0),
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
    "fidelity": maybe(FORM),
}


def check_record(state: Any, dim: int, size: Sequence[int]) -> None:
    """Raise ValueError unless `state` can be that of a run with `dim` parameters, size (H, W)."""
    sides = {"d": dim, "H": size[0], "W": size[1]}
    check(state, _RECORD, sides, "record")
    asked, evaluations = int(state["generations"].sum()), sides["e"]
    if asked != evaluations + sides.get("p", 0):
        raise ValueError(f"of {asked} candidates asked, {evaluations} were evaluated")
    if sides["m"] and int(state["improvements"].max()) >= evaluations:
        raise ValueError(f"an improvement after all {evaluations} evaluations")
