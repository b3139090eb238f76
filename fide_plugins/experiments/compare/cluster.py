"""Work items on the workers of a Dask cluster, which write to a shared folder.

Each worker must have one thread, `dask worker --nthreads 1`: runs in one process would distort
each other's measured time.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from fide_plugins.errors import DependencyError, OptionError

__all__ = ["on_dask"]

_TIMEOUT = 20.0  # seconds until the scheduler must answer, and until one worker must be there


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
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise DependencyError(
            "--dask needs the package distributed: pip install 'fide-plugins[dask]'"
        ) from error
    try:
        client: Any = Client(address, timeout=_TIMEOUT, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as error:
        raise OptionError(f"no Dask scheduler answers at {address}: {error}") from error
    with client:
        _check(client, out)
        futures = {client.submit(work, item, pure=False): item for item in items}
        completed: Any = as_completed(futures, loop=client.loop)  # type: ignore[no-untyped-call]
        for future in completed:
            if future.status == "finished":
                yield future.result()
            else:
                yield lost(futures[future], f"Dask gave up this run: {future.exception()!r}")


def _check(client: Any, out: Path) -> None:
    """Raise OptionError unless every worker has one thread and sees the folder."""
    try:
        client.wait_for_workers(1, timeout=_TIMEOUT)
    except TimeoutError as error:
        raise OptionError("the Dask cluster has no worker; start one: dask worker") from error
    for name, worker in client.scheduler_info(n_workers=-1)["workers"].items():
        if worker["nthreads"] != 1:
            raise OptionError(
                f"the Dask worker {name} has {worker['nthreads']} threads, which would distort the "
                "measured time; start it with: dask worker --nthreads 1"
            )
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
