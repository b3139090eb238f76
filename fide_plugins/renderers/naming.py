"""Parameters by flat names, and as a line of text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def flat(params: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Pairs of flat names, as `Space.names` has them, and values of nested parameters.

    >>> flat({"sun": 3.0, "beads": [{"x": 0.1}, {"x": 0.2}]})
    [('sun', 3.0), ('beads[0].x', 0.1), ('beads[1].x', 0.2)]
    """
    pairs: list[tuple[str, Any]] = []
    for key, value in params.items():
        if isinstance(value, Mapping):
            pairs += flat(value, f"{prefix}{key}.")
        elif isinstance(value, list):
            for i, each in enumerate(value):
                pairs += flat(each, f"{prefix}{key}[{i}].")
        else:
            pairs.append((f"{prefix}{key}", value))
    return pairs


def described(params: object) -> str:
    """Parameters, or a point of the cube, in a line of text.

    >>> described({"sun": 0.123456789, "floor": "wood"})
    'sun=0.123457, floor=wood'
    """
    if isinstance(params, Mapping):
        return ", ".join(f"{name}={_short(value)}" for name, value in flat(params))
    return f"x={np.array2string(np.asarray(params), precision=6, threshold=20)}"


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
