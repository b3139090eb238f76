"""What is known of a run, from the files of its directory, which may be anybody's."""

from __future__ import annotations

import csv
import io
import json
import os
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from fide_plugins.recording.directory import LOCK
from fide_plugins.recording.parameters import rows
from fide_plugins.recording.storage import CHECKPOINT, read_record
from fide_plugins.renderers.naming import flat
from fide_plugins.runtime.files import MOST_BYTES, is_locked, read_regular
from fide_plugins.space import Space
from fide_plugins.validation.values import MAX_PIXELS

PICTURES = ("target.png", "best.png")
_PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
_SIZE = struct.Struct(">II")
_MOST_OF_JSON = 2**24
_MOST_POINTS = 1000


class RunFiles:
    """Files of one run directory, by a fixed list of names."""

    def __init__(self, directory: str | os.PathLike[str]) -> None:
        self.path = Path(directory)
        self._kept: dict[str, tuple[Any, dict[str, Any]]] = {}  # by name: its mark, what it says

    def picture(self, name: str) -> bytes | None:
        """PNG of that name in `PICTURES`; None if there is none."""
        data = self._read(name)
        return data if data is not None and _is_picture(data) else None

    def state(self) -> dict[str, Any]:
        """Everything the page shows, as JSON has it; what is not known is absent."""
        run = self._json("run.json")
        settings, limits, totals = (
            one if isinstance(one := run.get(name), dict) else {}
            for name in ("settings", "limits", "totals")
        )
        shown: dict[str, Any] = {
            "state": _text(run.get("state", "not begun")),
            "task": _text(settings.get("task", self.path.name)),
            "optimizer": _text(settings.get("optimizer", "")),
            "loss": _text(settings.get("loss", "loss")),
            "pictures": {name: str(mark[0]) for name in PICTURES if (mark := self._mark(name))},
            "improvements": [],
            "parameters": [],
        }
        budget = limits.get("budget", settings.get("budget"))
        if type(budget) is int and 0 < budget < 2**53:
            shown["budget"] = budget
        shown |= self._once("curve.csv", lambda: _curve_of(self._read("curve.csv") or b""))
        shown |= self._once(CHECKPOINT, lambda: self._checkpoint(settings))
        if shown["state"] != "running":  # else totals are those of an earlier call
            shown["sentence"] = _text(totals.get("sentence", ""))
            shown["parameters"] = shown["parameters"] or _found(totals)
        elif is_locked(self.path / LOCK) is False:
            shown["state"] = "stopped without an end; continue with --resume"
        return shown

    def _read(self, name: str, most: int = MOST_BYTES) -> bytes | None:
        try:
            return read_regular(self.path / name, most, links=False)
        except OSError:
            return None

    def _mark(self, name: str) -> tuple[int, int] | None:
        try:
            about = (self.path / name).stat(follow_symlinks=False)
        except OSError:
            return None
        return about.st_mtime_ns, about.st_size

    def _once(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """What a file says, read again when it has changed."""
        mark = self._mark(name)
        if name not in self._kept or self._kept[name][0] != mark:
            self._kept[name] = mark, make()
        return self._kept[name][1]

    def _json(self, name: str) -> dict[str, Any]:
        try:
            found = json.loads(self._read(name, _MOST_OF_JSON) or b"{}")
        except (ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) else {}

    def _checkpoint(self, settings: dict[str, Any]) -> dict[str, Any]:
        """Parameters of the best candidate, and how many renders have failed."""
        try:
            if (self.path / CHECKPOINT).is_symlink():
                return {}
            record, _ = read_record(self.path, int(settings["dim"]), settings["size"])
            space = None if settings.get("space") is None else Space.from_dict(settings["space"])
            best = record.best
            table = [] if best is None else rows([replace(best, space=space)])
        except Exception:  # whatever a damaged file causes
            return {}
        parameters = [[row.name, row.values[0], row.unit] for row in table[:_MOST_POINTS]]
        return {"parameters": parameters, "failures": record.failures}


def _curve_of(data: bytes) -> dict[str, Any]:
    lines = csv.DictReader(io.TextIOWrapper(io.BytesIO(data), "utf-8", "replace", newline=""))
    points: list[list[float]] = []
    number, seconds = 0, 0.0
    try:
        for number, row in enumerate(lines, 1):
            best, seconds = float(row["best_loss"]), float(row["seconds"])
            if abs(best) < 2**53 and (not points or best < points[-1][1]):
                points.append([number, best])
    except (KeyError, TypeError, ValueError, csv.Error):
        return {}
    if not points or not seconds < 2**53:
        return {}
    step = 1 + len(points) // _MOST_POINTS
    known = {"evaluations": number, "best_loss": points[-1][1], "seconds": seconds}
    return {**known, "improvements": [*points[:-1:step], points[-1]]}


def _is_picture(data: bytes) -> bool:
    """Whether it begins as a PNG that may be decoded: a few bytes may say billions of pixels."""
    if not data.startswith(_PNG) or len(data) < len(_PNG) + _SIZE.size:
        return False
    width, height = _SIZE.unpack_from(data, len(_PNG))
    return bool(width * height <= MAX_PIXELS)


def _text(value: Any) -> str:
    return str(value)[:300]


def _found(totals: dict[str, Any]) -> list[list[str]]:
    """Parameters that a run which has ended has found."""
    params = totals.get("params")
    try:
        pairs = flat(params) if isinstance(params, dict) else []
    except RecursionError:
        return []
    shown = [(k, f"{v:.5g}" if isinstance(v, float) else v) for k, v in pairs[:_MOST_POINTS]]
    return [[_text(k), _text(v), ""] for k, v in shown]
