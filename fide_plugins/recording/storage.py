"""Files of a run as others read them: its record, its checkpoint.

`run.ckpt` names the file of the optimizer, which is written first: any kill leaves a pair.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from fide_plugins.errors import CheckpointError, FideError
from fide_plugins.recording.record import Record, check_record
from fide_plugins.runtime import checkpoint
from fide_plugins.runtime.files import RefusedFileError, read_regular
from fide_plugins.runtime.schema import IMPOSSIBLE

if TYPE_CHECKING:
    from fide_plugins.types import Optimizer


FORMAT = 2
TARGET_FILE = "target.ckpt"
"""The target of a run of the lab, to the last bit."""
_OF_PICTURES = {
    "weights": "the mask or the weights differ",
    "target": "the target is another one; undo the edit, or begin anew with one that a file has",
}


class RunDirectoryError(FideError, FileExistsError):
    """A directory belongs to another run, is no run directory, or another process works on it."""


def read_run(path: Path) -> dict[str, Any] | None:
    """Contents of `run.json` in the folder `path`; None if there is none."""

    def check_contents(run: dict[str, Any]) -> None:
        if not isinstance(run["state"], str):
            raise ValueError("its state is no text")
        if not isinstance(run["settings"], dict) or not isinstance(run.get("resumed", []), list):
            raise ValueError("its settings are no dict, or its times of resuming no list")

    return read_json(path / "run.json", "run", check_contents)


def read_json(
    path: Path, kind: str, check: Callable[[dict[str, Any]], None]
) -> dict[str, Any] | None:
    """Record of a run or of a comparison (`kind`) in a file, as `check` allows; None: no file."""
    if not path.exists():
        return None
    try:
        record: dict[str, Any] = json.loads(read_regular(path).decode())
        if record["format"] != FORMAT:
            raise ValueError(f"format {record['format']!r}, and this version reads {FORMAT}")
        check(record)
    except (RefusedFileError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise RunDirectoryError(
            f"{path} is not the record of a {kind} of this version ({error}); "
            "copy that file back, or name another directory"
        ) from error
    return record


def check_settings(there: dict[str, Any], here: dict[str, Any], what: str) -> None:
    """Raise RunDirectoryError (a FileExistsError), naming the first setting that differs."""
    for key in [*here, *(k for k in there if k not in here)]:
        if there.get(key) != here.get(key):
            values = f"{key} is {there.get(key)!r} there and {here.get(key)!r} here"
            raise RunDirectoryError(
                f"{what} with other settings: {_OF_PICTURES.get(key, values)}; "
                "use the same settings, or name another directory"
            )


def checksum(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(read_regular(path)).hexdigest()


def now() -> str:
    """Time of day in UTC, in the format of ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


_T = TypeVar("_T")

CHECKPOINT = "run.ckpt"
_RUN = "run"
_OPTIMIZER_FILE = re.compile(r"optimizer-[0-9]+-[0-9]+(-[0-9]+)?\.ckpt")


def is_saved(path: str | os.PathLike[str]) -> bool:
    """Whether the folder `path` holds the state of a run, from which it can continue.

    False where it may not be read: whoever writes there says that.
    """
    return os.path.exists(Path(path) / CHECKPOINT)


def read_checkpoint(path: Path) -> tuple[Any, str]:
    """State of the `Record` in `run.ckpt`, not checked, and the name of the optimizer's file."""
    state = checkpoint.read(path / CHECKPOINT, _RUN)
    with impossible(path / CHECKPOINT):
        name = state["optimizer"]
        if not _OPTIMIZER_FILE.fullmatch(name):
            raise ValueError(f"it names no optimizer's file of the run directory, {name!r}")
        return state["record"], name


def read_record(path: Path, dim: int, size: list[int]) -> tuple[Record, Path]:
    """Record of a run of `dim` parameters and images of size (H, W); its optimizer's file."""
    state, name = read_checkpoint(path)
    with impossible(path / CHECKPOINT):
        check_record(state, dim, size)
        return Record.from_state(state), path / name


def with_optimizer(path: Path, use: Callable[[Path], _T]) -> _T:
    """What a function makes of the optimizer's file of the run in the folder `path`.

    The run may go on meanwhile, and replace its checkpoint: then it is called with the newer file.
    """
    _, name = read_checkpoint(path)
    while True:
        try:
            return use(path / name)
        except FileNotFoundError:
            _, newer = read_checkpoint(path)
            if newer == name:
                raise
            name = newer


def write_checkpoint(path: Path, record: Record, optimizer: Optimizer) -> None:
    """Write the state of a run into the folder `path`.  Raises OSError."""
    pending = 0 if record.pending is None else len(record.pending)
    failed = f"-{record.failures}" if record.failures else ""  # others were asked instead
    name = f"optimizer-{record.evaluations}-{pending}{failed}.ckpt"  # one name for each state
    optimizer.save(path / name)
    checkpoint.write(path / CHECKPOINT, _RUN, {"record": record.state(), "optimizer": name})
    _remove_optimizers(path, but=name)


def _remove_optimizers(path: Path, but: str = "") -> None:
    for file in path.glob("optimizer-*.ckpt"):
        if file.name != but and _OPTIMIZER_FILE.fullmatch(file.name):
            with suppress(OSError):
                file.unlink()


@contextmanager
def impossible(file: Path, kind: type[FideError] = CheckpointError) -> Iterator[None]:
    """Turn errors of this block, which the contents of a file cause, into one of that kind."""
    try:
        yield
    except FideError:
        raise
    except IMPOSSIBLE as error:
        raise kind(f"{file}: impossible contents ({error}); copy that file back") from error
