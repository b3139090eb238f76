"""Where the files of one render are while it goes on.

A worker process that is killed (it took too long, the memory was full) cannot remove what it has
written.  So each worker gets a folder that its parent removes after its end.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["folder_of_a_render", "use"]

_PARENT: list[str] = []
"""Folder of this process; empty: that of the system."""


def use(folder: str) -> None:
    """Keep the files of all further renders of this process in a folder."""
    _PARENT[:] = [folder]


@contextmanager
def folder_of_a_render() -> Iterator[Path]:
    """A new folder, which is removed at the end of the block."""
    parent = _PARENT[0] if _PARENT else None
    with tempfile.TemporaryDirectory(
        prefix="fide-", dir=parent, ignore_cleanup_errors=True
    ) as name:
        yield Path(name)
