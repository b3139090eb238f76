"""Renders outside of the loop of a fit, in the workers of one."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import wait

from fide_plugins.fitting.rendering import Failed, Outcome
from fide_plugins.fitting.workers.base import LOOK, Workers, late
from fide_plugins.types import Float64

__all__ = ["gathered"]


def gathered(pool: Workers, X: Float64, limit: float | None) -> Iterator[Outcome]:
    """Outcome of each point of X (n, dim), in order; `pool.number` renders at a time.

    limit: seconds that a render may take, the start of its worker not counted; None: any time.
    """
    for first in range(0, len(X), pool.number):
        tasks = [pool.submit(x) for x in X[first : first + pool.number]]
        for task in tasks:
            while not task.done() and late(pool, [task], limit) is None:
                wait([task], None if limit is None else LOOK)
            if task.done():
                yield pool.outcome(task)
            else:
                pool.abandon(task)
                reason = f"it did not end within {limit:g} s, its time limit"
                yield Failed(reason, broken=True, killed=True)
