"""Executors for `minimize`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

__all__ = ["DaskExecutor"]


class DaskExecutor:
    """A Dask client as an executor, for parameters of any name and for noisy renderers.

    ``Client.submit`` itself uses some argument names: ``key``, ``workers``, ``retries`` and others
    never reach the objective.  It also returns an earlier result for a call with equal arguments.

    client: a `distributed.Client`.
    """

    def __init__(self, client: Any) -> None:
        self._client = client

    def submit(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Future of ``function(*args, **kwargs)``; the function is called each time."""
        return self._client.submit(_call, function, args, kwargs, pure=False)


def _call(function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    return function(*args, **kwargs)
