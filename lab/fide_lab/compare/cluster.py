"""Work items on the workers of a Dask cluster, which write to a shared folder."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from fide_plugins.errors import OptionError
from fide_plugins.runtime.machine import connected

__all__ = ["on_dask"]


def on_dask(
    work: Callable[[Any], Any],
    items: Sequence[Any],
    address: str,
    out: Path,
    lost: Callable[[Any, str], Any],
) -> Iterator[Any]:
    """Results of `work` for all items, in order of completion.

    work: a function that can be pickled.
    out: a folder that every worker must see.
    lost: gives the result for an item that Dask gives up, from the item and the reason.

    Raises DependencyError (an ImportError) without Dask, OptionError (a ValueError) if the cluster
    cannot be used.
    """
    with connected(address) as client:
        from distributed import as_completed

        _check(client, out)
        futures = {client.submit(work, item, pure=False): item for item in items}
        completed: Any = as_completed(futures, loop=client.loop)  # type: ignore[no-untyped-call]
        for future in completed:
            if future.status == "finished":
                yield future.result()
            else:
                yield lost(futures[future], f"Dask gave up this run: {future.exception()!r}")


def _check(client: Any, out: Path) -> None:
    """Raise OptionError unless every worker sees the folder."""
    probe = out / f".probe.{secrets.token_hex(6)}.tmp"
    probe.touch()
    try:
        for name, seen in client.run(_sees, str(probe)).items():
            if not seen:
                raise OptionError(
                    f"the Dask worker {name} does not see {out.resolve()}; name a folder that all "
                    "machines share under the same path"
                )
    finally:
        probe.unlink()


def _sees(path: str) -> bool:
    return Path(path).exists()
