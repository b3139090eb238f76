"""NumPy's global generator as the baselines lend it to a library, for the library's own runs."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from fide_plugins.types import Float64


@contextmanager
def seeded_globally(seed: int) -> Iterator[None]:
    """With that generator seeded, and without the library's warnings."""
    users: Any = np.random.get_state()
    bits = np.random.MT19937(np.random.SeedSequence(seed))
    np.random.set_state(np.random.RandomState(bits).get_state())
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        np.random.set_state(users)


def recorded(
    minimize: Callable[..., object],
    loss: Callable[[Float64], Float64],
    dim: int,
    seed: int,
    evaluations: int,
    **arguments: Any,
) -> tuple[list[Float64], int]:
    """Points of one of pycma's own functions, called with a plain function, and searches begun.

    The first search begins in the middle, every other one at random.  `loss` takes points (n, dim)
    and gets them clipped to the unit cube; the points are returned as the library passed them.
    """
    points: list[Float64] = []
    begun = 0

    def function(x: Float64) -> float:
        points.append(x.copy())
        if len(points) > evaluations:
            raise StopIteration
        return float(loss(np.clip(x, 0.0, 1.0)[None])[0])

    def x0() -> Float64:
        nonlocal begun
        begun += 1
        return np.full(dim, 0.5) if begun == 1 else np.random.random(dim)

    options: dict[str, Any] = {"bounds": [0, 1], "seed": np.nan, "verbose": -9, "verb_log": 0}
    with seeded_globally(seed), suppress(StopIteration):
        minimize(function, x0, 0.2, options, restarts=9, **arguments)
    assert len(points) > evaluations, "the library ended before its budget"
    return points[:evaluations], begun
