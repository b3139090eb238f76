"""Seconds by part."""

from __future__ import annotations

import time
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager

__all__ = ["timed"]


@contextmanager
def timed(
    times: MutableMapping[str, float], part: str, *, instead_of: str | None = None
) -> Iterator[None]:
    """Count the time as that of `part`, and take it from the part that counts it too.

    What raises is not counted: an error changes nothing.
    """
    start = time.perf_counter()
    yield
    elapsed = time.perf_counter() - start
    times[part] += elapsed
    if instead_of is not None:
        times[instead_of] -= elapsed
