"""What the state of a `MovePolicy` must be like, apart from that of its parts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fide_plugins.population.candidate import TrainingSample
from fide_plugins.runtime.schema import (
    Schema,
    Sides,
    array,
    check,
    each,
    flag,
    form,
    maybe,
    real,
    row,
    text,
    whole,
)
from fide_plugins.search.moves.base import Known, Move, Stage

__all__ = ["check_policy"]

_UNIT = array("d", low=0.0, high=1.0)
_SCHEMA: dict[str, Schema] = {
    "stage": text,
    "move": maybe(text),
    "start": {
        "mean": _UNIT,
        "std": array("d", low=0.0, high=1e6),
        "population": whole(1, 2**10),
        "patience": whole(1, 100),
        "brisk_above": maybe(real()),
        "widest": real(1.0),
        "to_the_end": flag,
        "held": maybe(array("d", kind="b")),
    },
    "loss_only_searches": whole(),
    "guided": flag,
    "noise": maybe(real(0.0)),
    "incumbent": maybe(form(TrainingSample)),
    "optima": {
        "samples": each(form(TrainingSample)),
        "counts": each(row(whole(), whole(), whole(high=1))),
        "descents": whole(),
        "forgotten": whole(),
    },
}


def check_policy(state: Mapping[str, Any], known: Known, moves: Mapping[str, Move]) -> None:
    """Raise ValueError unless this can be the state of a policy for such a scene.

    known: what is known of the scene at first.  moves: all moves by their names.
    """
    tokens, channels = known.target.shape
    sides: Sides = {"d": known.dim, "T": tokens, "C": channels}
    for name, schema in _SCHEMA.items():
        check(state[name], schema, sides, f"moves[{name!r}]")
    stage = Stage(state["stage"])
    if state["move"] is not None and state["move"] not in moves:
        raise ValueError(f"moves['move'] is {state['move']!r}, which is none of {', '.join(moves)}")
    if stage in (Stage.RESTART, Stage.REMOVAL, Stage.SENSITIVITY) and state["move"] is None:
        raise ValueError(f"moves['move'] is None in the stage {stage.value!r}")
    free = stage is Stage.RESTART and not moves[state["move"]].from_incumbent
    if stage is not Stage.SEARCH and not free and state["incumbent"] is None:
        raise ValueError(f"moves['incumbent'] is None in the stage {stage.value!r}")
    blocks = state["exchangeability"]["blocks"]
    if stage is Stage.REMOVAL and blocks is None:
        raise ValueError("moves['exchangeability']['blocks'] is None while blocks are removed")
