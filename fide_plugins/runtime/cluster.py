"""A Dask cluster that a user names by the address of its scheduler.

Each worker must have one thread, `dask worker --nthreads 1`: what runs beside something else in
one process would share its state, and distort its measured time.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from fide_plugins.errors import OptionError
from fide_plugins.runtime.extras import missing

__all__ = ["connected", "workers_of"]

_TIMEOUT = 20.0  # seconds until the scheduler must answer, and until one worker must be there


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """Client of the cluster whose scheduler has this address; closed at the end.

    Raises DependencyError (an ImportError) without Dask, OptionError (a ValueError) if the
    scheduler does not answer, there is no worker, or one has several threads.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise missing("dask", "--dask needs the package distributed") from error
    try:
        client: Any = Client(address, timeout=_TIMEOUT, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as error:
        raise OptionError(f"no Dask scheduler answers at {address}: {error}") from error
    with client:
        _check(client)
        yield client


def workers_of(client: Any) -> dict[str, Any]:
    """What the scheduler knows of each worker, by its address."""
    found: dict[str, Any] = client.scheduler_info(n_workers=-1)["workers"]
    return found


def _check(client: Any) -> None:
    """Raise OptionError unless there are workers, each of one thread."""
    try:
        client.wait_for_workers(1, timeout=_TIMEOUT)
    except TimeoutError as error:
        raise OptionError("the Dask cluster has no worker; start one: dask worker") from error
    for name, worker in workers_of(client).items():
        if worker["nthreads"] != 1:
            raise OptionError(
                f"the Dask worker {name} has {worker['nthreads']} threads, whose tasks would share "
                "one process and each other's time; start it with: dask worker --nthreads 1"
            )
