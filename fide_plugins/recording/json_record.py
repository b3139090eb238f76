"""The record of a run, `run.json`, or of a comparison: read, and compared with other settings."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fide_plugins.errors import FideError
from fide_plugins.runtime.files import RefusedFileError, read_regular

__all__ = [
    "FORMAT",
    "RunDirectoryError",
    "check_settings",
    "checksum",
    "now",
    "read_json",
    "read_run",
]

FORMAT = 2
_OF_PICTURES = {
    "weights": "the mask or the weights differ",
    "target": "the target is another one; undo the edit, or begin anew with one that a file has",
}


class RunDirectoryError(FideError, FileExistsError):
    """A directory belongs to another run, is no run directory, or another process works on it."""


def read_run(path: Path) -> dict[str, Any] | None:
    """Contents of `run.json` in the folder `path`; None if there is none.

    Raises RunDirectoryError (a FileExistsError) if it is damaged or of another version.
    """
    run = read_json(path / "run.json", "run", _check_contents)
    return None if run is None else _of_this_version(run)


def _of_this_version(run: dict[str, Any]) -> dict[str, Any]:
    """The record with names of today: once "status" was what is "state" now."""
    if "state" not in run and "status" in run:
        run["state"] = run.pop("status")
        totals = run.get("totals")
        if isinstance(totals, dict) and "status" in totals:
            totals["sentence"] = totals.pop("status")
    return run


def _check_contents(run: dict[str, Any]) -> None:
    if not isinstance(run["settings"], dict) or not isinstance(run.get("resumed", []), list):
        raise ValueError("its settings are no dict, or its times of resuming no list")


def read_json(
    path: Path, kind: str, check: Callable[[dict[str, Any]], None]
) -> dict[str, Any] | None:
    """Record of a run or of a comparison (`kind`) in the file `path`; None if there is none.

    check: raises ValueError, KeyError or TypeError for contents that cannot be.

    Raises RunDirectoryError (a FileExistsError) if it is damaged or of another version.
    """
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
