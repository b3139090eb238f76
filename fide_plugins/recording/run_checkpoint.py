"""The state from which a run goes on: `run.ckpt`, and the file of the optimizer that it names.

The optimizer is written first, under a new name; then `run.ckpt`; then the old file is removed.  So
a kill at any moment leaves a consistent pair.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from fide_plugins.errors import CheckpointError
from fide_plugins.recording.record import Record
from fide_plugins.recording.record_schema import check_record
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.schema import IMPOSSIBLE

if TYPE_CHECKING:
    from fide_plugins.types import Optimizer

__all__ = [
    "NAME",
    "RunCheckpoint",
    "is_saved",
    "read_checkpoint",
    "read_record",
    "remove_checkpoint",
    "with_optimizer",
    "write_checkpoint",
]

_T = TypeVar("_T")

NAME = "run.ckpt"
_KIND = "run"
_OPTIMIZER_FILE = re.compile(r"optimizer-[0-9]+-[0-9]+(-[0-9]+)?\.ckpt")


def is_saved(path: str | os.PathLike[str]) -> bool:
    """Whether the folder `path` holds the state of a run, from which it can continue.

    False where it may not be read: whoever writes there says that.
    """
    return os.path.exists(Path(path) / NAME)


class RunCheckpoint(NamedTuple):
    """Contents of `run.ckpt`."""

    record: Any
    """State of the `Record`, not checked."""
    optimizer: str
    """Name of the optimizer's file in the same folder."""


def read_checkpoint(path: Path) -> RunCheckpoint:
    """State of the run in the folder `path`, see `is_saved`.

    Raises OSError, or CheckpointError (a ValueError) if the file is damaged or names a file that is
    no optimizer's of the folder.
    """
    state = checkpoint.read(path / NAME, _KIND)
    with _possible(path):
        name = state["optimizer"]
        if not _OPTIMIZER_FILE.fullmatch(name):
            raise ValueError(f"it names no optimizer's file of the run directory, {name!r}")
        return RunCheckpoint(state["record"], name)


def read_record(path: Path, dim: int, size: list[int]) -> tuple[Record, Path]:
    """Record of the run in the folder `path`, of `dim` parameters, and its optimizer's file.

    size: height and width of its images.

    Raises what `read_checkpoint` raises, CheckpointError also for a record that cannot be.
    """
    state, name = read_checkpoint(path)
    with _possible(path):
        state.setdefault("path", np.empty((0, dim)))  # of an earlier version
        check_record(state, dim, size)
        return Record.from_state(state), path / name


def with_optimizer(path: Path, use: Callable[[Path], _T]) -> _T:
    """What a function makes of the optimizer's file of the run in the folder `path`.

    The run may go on meanwhile, and replace its checkpoint: then it is called with the newer file.

    Raises what `read_checkpoint` and the function raise.
    """
    name = read_checkpoint(path).optimizer
    while True:
        try:
            return use(path / name)
        except FileNotFoundError:
            newer = read_checkpoint(path).optimizer
            if newer == name:
                raise
            name = newer


def write_checkpoint(path: Path, record: Record, optimizer: Optimizer) -> None:
    """Write the state of a run into the folder `path`.  Raises OSError."""
    pending = 0 if record.pending is None else len(record.pending)
    failed = f"-{record.failures}" if record.failures else ""  # others were asked instead
    name = f"optimizer-{record.evaluations}-{pending}{failed}.ckpt"  # one name for each state
    optimizer.save(path / name)
    checkpoint.write(path / NAME, _KIND, {"record": record.state(), "optimizer": name})
    _remove_optimizers(path, but=name)


def remove_checkpoint(path: Path) -> None:
    """Remove the state from the folder `path`, as far as that is possible."""
    with suppress(OSError):
        (path / NAME).unlink()
    _remove_optimizers(path)


def _remove_optimizers(path: Path, but: str = "") -> None:
    for file in path.glob("optimizer-*.ckpt"):
        if file.name != but and _OPTIMIZER_FILE.fullmatch(file.name):
            with suppress(OSError):
                file.unlink()


@contextmanager
def _possible(path: Path) -> Iterator[None]:
    """Turn errors of this block, which `run.ckpt` in the folder `path` causes, into one."""
    try:
        yield
    except IMPOSSIBLE as error:
        raise CheckpointError(f"{path / NAME}: impossible contents ({error})") from error
