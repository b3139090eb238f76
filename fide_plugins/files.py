"""Files that are either wholly there or not there at all.

Everything the library writes goes through :func:`atomic_writer`: the bytes go to a temporary file
in the same folder, are flushed to the disk, and the file is then renamed over its place.  A reader,
or the next process after a kill, sees the old file or the new one and never a part of either.
"""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

__all__ = [
    "atomic_writer",
    "check_writable",
    "locked",
    "remove_leftovers",
    "write_bytes",
    "write_text",
]

_SUFFIX = ".tmp"


@contextmanager
def atomic_writer(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """Open a binary file that takes the place of `path` when the block ends without an error.

    Raises OSError, naming `path`, if its folder is missing or cannot be written or the disk is
    full; `path` is then what it was before.
    """
    final = Path(path)
    if final.is_dir():
        raise IsADirectoryError(f"cannot write {final}: it is a folder; name a file")
    temporary = final.with_name(f".{final.name}.{secrets.token_hex(6)}{_SUFFIX}")
    try:
        # The mode is that of an ordinary new file; mkstemp would make it private.
        descriptor = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY | _O_BINARY, 0o666)
        with os.fdopen(descriptor, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, final)
        _sync_folder(final.parent)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and error.errno is not None:
            raise type(error)(error.errno, f"cannot write {final}: {_why(error)}") from error
        raise


def _why(error: OSError) -> str:
    """What went wrong, and what can be done about it."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    remedy = "make room, or name another folder" if full else "name a folder that can be written"
    return f"{error.strerror}; {remedy}"


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write `data` to `path`, atomically."""
    with atomic_writer(path) as file:
        file.write(data)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` to `path` as UTF-8, atomically."""
    write_bytes(path, text.encode())


def check_writable(folder: str | os.PathLike[str]) -> None:
    """Make `folder` if need be, and raise OSError unless a file can be written there."""
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".probe.{secrets.token_hex(6)}{_SUFFIX}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        message = f"cannot write to the folder {path}: {error.strerror}; name another one"
        raise type(error)(error.errno, message) from error


def remove_leftovers(folder: str | os.PathLike[str]) -> None:
    """Remove temporary files that a killed process left in `folder`."""
    for leftover in Path(folder).glob(f".*{_SUFFIX}"):
        with suppress(OSError):
            leftover.unlink()


_O_BINARY = getattr(os, "O_BINARY", 0)  # Windows would translate line ends without it


def _sync_folder(folder: Path) -> None:
    """Flush the rename itself to the disk, where the system can do that for a folder."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def locked(path: str | os.PathLike[str], wait: bool = False) -> Iterator[bool]:
    """Hold the file `path`, made if need be, as a lock; gives False if another process holds it.

    wait: until the other lets go of it; then it gives True.
    The system lets go of it when a process ends, however it ends.  Where the system has no such
    locks (Windows) it gives True always.
    """
    try:
        import fcntl
    except ImportError:
        yield True
        return
    descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
        else:
            yield True
    finally:
        os.close(descriptor)
