"""Tries a user's function of images before anything depends on it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fide_plugins.errors import FideError
from fide_plugins.types import Float32

__all__ = ["differs", "name_of", "own_name", "tried_on"]

_RELATIVE, _ABSOLUTE = 1e-3, 1e-5  # kernels of networks round differently for each batch size


def name_of(function: object) -> str:
    """Name of a function, or of the class of another callable."""
    return str(getattr(function, "__name__", type(function).__name__))


def own_name(thing: object) -> str:
    """Name that a thing gives itself, or else that of its function or class."""
    name = getattr(thing, "name", None)
    return name if isinstance(name, str) and name else name_of(thing)


def tried_on(
    target: Float32, function: Callable[[Float32], Any], what: str, error: type[FideError]
) -> tuple[Any, Any]:
    """Values of the target (H, W, 3) and its negative: together, and each alone, (2, ...) each.

    Raises `error` in place of what the function raises, naming it, but for our own errors.
    """
    both = np.stack([target, 1 - target])
    try:
        together = function(both)
        return together, np.concatenate([function(both[:1]), function(both[1:])])
    except FideError:
        raise
    except Exception as cause:
        raise error(
            f"{what} was tried on two images, an array of shape {both.shape} and dtype float32, "
            f"and raised {cause!r}; it gets batches of any number of images"
        ) from cause


def differs(together: Any, alone: Any) -> bool:
    """Whether two arrays (2, ...) differ by more than kernels may round."""
    scale = max(float(np.abs(alone[np.isfinite(alone)]).max(initial=0.0)), _ABSOLUTE)
    return not np.allclose(together, alone, rtol=_RELATIVE, atol=_ABSOLUTE * scale, equal_nan=True)
