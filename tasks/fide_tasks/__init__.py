"""Inverse problems with pictures as data: parameters in [0, 1] go in, images come out.

    >>> import fide_tasks
    >>> task = fide_tasks.make("voronoi", size=64)
    >>> task.dim, task.target.shape
    (40, (64, 64, 3))

Importing this package loads no task and no renderer; `make` loads the one it is asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fide_tasks.registry import make, names, options

if TYPE_CHECKING:
    from fide_tasks.base import Parameter, Task

__all__ = ["Parameter", "Task", "make", "names", "options"]


def __getattr__(name: str) -> Any:
    if name in ("Parameter", "Task"):
        from fide_tasks import base

        return getattr(base, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
