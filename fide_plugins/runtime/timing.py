"""Seconds by part."""

from __future__ import annotations

import time
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager

__all__ = ["timed"]


@contextmanager
def timed(times: MutableMapping[str, float], part: str) -> Iterator[None]:
    """Add the time of this block to `part`, without the time that it adds to other parts.

    A block that raises adds nothing: an error must not change the state.
    """
    others, start = sum(times.values()), time.perf_counter()
    yield
    elapsed = time.perf_counter() - start
    times[part] += max(0.0, elapsed - (sum(times.values()) - others))
