"""Atomic writes, reading of files that may be anybody's, and file locks."""

from __future__ import annotations

import errno
import os
import re
import secrets
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

MOST_BYTES = 2**28
"""Most bytes of a file that is read whole: a sparse one of a terabyte costs nobody anything."""
_SUFFIX = ".tmp"
_TEMPORARY = re.compile(r"\.(.+)\.[0-9a-f]{12}\.tmp")
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EBADF)
"""Errors of a file system that has no locks; the last one of NFS, for a file opened to be read."""
_MOMENT = 0.005  # seconds; `is_locked` has a lock for some microseconds


class RefusedFileError(OSError):
    """What is not read: no regular file, which might be waited for or have no end, or too large."""


@contextmanager
def atomic_writer(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """Open a binary file that replaces `path` when the block ends without an error.

    The bytes go to a temporary file in the same folder, are flushed to the disk, and the file is
    renamed: a reader, or the next process after a kill, sees the old file or the new one.

    Raises OSError, naming `path`, if its folder is missing or not writable, or if the disk is
    full; `path` then stays as it was.
    """
    final = Path(path)
    if final.is_dir():
        raise IsADirectoryError(f"cannot write {final}: it is a folder; name a file")
    temporary = final.with_name(f".{final.name}.{secrets.token_hex(6)}{_SUFFIX}")
    try:
        # With the mode of an ordinary new file; mkstemp would make the file private.
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
        if not isinstance(error, OSError) or error.errno is None:
            raise
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        remedy = "make room, or name another" if full else "name a folder that can be written"
        message = f"cannot write {final}: {error.strerror}; {remedy}"
        raise type(error)(error.errno, message) from error


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write `data` to `path`, atomically."""
    with atomic_writer(path) as file:
        file.write(data)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` to `path` as UTF-8, atomically."""
    write_bytes(path, text.encode())


def open_regular(path: str | os.PathLike[str], *, links: bool = True) -> IO[bytes]:
    """Open a file to be read, without waiting for anybody; `links`: through symbolic ones, too.

    Raises RefusedFileError (an OSError) for a pipe, a socket or a device, IsADirectoryError for a
    folder, and other OSErrors.
    """
    flags = os.O_RDONLY | _O_BINARY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
    check_regular(path, links=links)  # some devices act when they are opened
    file = os.fdopen(os.open(path, flags | (0 if links else _NO_LINKS)), "rb")
    try:
        check_regular(file.fileno())  # it may be another one by now
    except BaseException:
        file.close()
        raise
    return file


def check_regular(path: str | os.PathLike[str] | int, *, links: bool = True) -> None:
    """Raise what `open_regular` raises, for what opens the file by itself."""
    mode = os.stat(path, follow_symlinks=links or isinstance(path, int)).st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(f"cannot read {path}: it is a folder; name a file")
    if not stat.S_ISREG(mode):
        what = "a link" if stat.S_ISLNK(mode) else "a pipe, a socket or a device"
        raise RefusedFileError(f"cannot read {path}: it is {what}; name a file")


def read_regular(
    path: str | os.PathLike[str], most: int = MOST_BYTES, *, links: bool = True
) -> bytes:
    """Contents of a file, see `open_regular`; RefusedFileError for more than `most` bytes."""
    with open_regular(path, links=links) as file:
        data = file.read(most + 1) if os.fstat(file.fileno()).st_size <= most else None
    if data is None or len(data) > most:  # a file of /proc has no size
        raise RefusedFileError(f"cannot read {os.fspath(path)}: it has more than {most:,} bytes")
    return data


def check_writable(folder: str | os.PathLike[str]) -> None:
    """Make `folder` if it is missing; raise OSError unless a file can be written there."""
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".probe.{secrets.token_hex(6)}{_SUFFIX}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        message = f"cannot write to the folder {path}: {error.strerror}; name another one"
        raise type(error)(error.errno, message) from error


def remove_leftovers(
    folder: str | os.PathLike[str],
    *,
    age: float = 0.0,
    mine: Callable[[str], bool] = lambda name: True,
) -> None:
    """Remove temporary files that a killed process left in `folder`.

    age: seconds since they were last written, at least.  mine: whether nobody else writes a file of
    that name now.
    """
    for leftover in Path(folder).glob(f".*{_SUFFIX}"):
        of = _TEMPORARY.fullmatch(leftover.name)
        with suppress(OSError):
            old = not age or time.time() - leftover.stat().st_mtime >= age
            if of is not None and old and mine(of[1]):
                leftover.unlink()


_O_BINARY = getattr(os, "O_BINARY", 0)  # Windows would translate line ends without it
_NO_LINKS = getattr(os, "O_NOFOLLOW", 0)  # a lock is made: a link would lead out of its folder


def _sync_folder(folder: Path) -> None:
    """Flush the rename itself to the disk, if the system can sync a folder."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def locked(path: str | os.PathLike[str], wait: bool = False) -> Iterator[bool]:
    """Lock the file `path`, made if it is missing; yields whether this process holds the lock.

    wait: wait for it.  The system releases the lock when a process ends, however; processes that it
    has forked do not hold it.  Where there are no such locks (Windows, some network file systems)
    the result is always True.
    """
    if fcntl is None:
        yield True
        return
    descriptor = os.open(path, os.O_CREAT | os.O_RDWR | _NO_LINKS, 0o666)
    _HELD.add(descriptor)
    try:
        how = fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB)
        mine = _flock(descriptor, how)
        if mine is False:
            time.sleep(_MOMENT)
            mine = _flock(descriptor, how)
        yield mine is not False
    finally:
        if descriptor in _HELD:  # not in a forked process, whose parent has the lock
            _HELD.remove(descriptor)
            os.close(descriptor)


_HELD: set[int] = set()  # descriptors of the locks of this process


def _close_all() -> None:
    while _HELD:
        os.close(_HELD.pop())


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_close_all)


def is_locked(path: str | os.PathLike[str]) -> bool | None:
    """Whether a process, this one included, holds the lock of the file `path`.

    None where that cannot be known: there is no such file, or there are no locks.
    """
    if fcntl is None:
        return None
    try:
        descriptor = os.open(path, os.O_RDONLY | _NO_LINKS | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        free = _flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)  # until it is closed, at once
        return None if free is None else not free
    finally:
        os.close(descriptor)


def _flock(descriptor: int, how: int) -> bool | None:
    """Lock an open file; False: another process has the lock, None: there are no locks."""
    try:
        fcntl.flock(descriptor, how)
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return None
        if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
            raise
        return False
    return True
