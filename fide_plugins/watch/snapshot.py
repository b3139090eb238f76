"""What is known of a run, from the files of its directory, which may be anybody's."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import struct
import time
from pathlib import Path
from typing import Any

from fide_plugins.recording.directory import LIVE, is_under_way
from fide_plugins.renderers.naming import flat
from fide_plugins.runtime.files import MOST_BYTES, read_regular
from fide_plugins.validation.pixels import MAX_PIXELS

__all__ = ["PICTURES", "RunFiles"]

PICTURES = ("target.png", "best.png")
_PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
_SIZE = struct.Struct(">II")
_MOST_OF_JSON = 2**24
_MOST_POINTS = 1000
_QUIET = 30.0  # seconds without a new file before a run may be said to have stopped
_WRITTEN = ("run.json", "run.ckpt", "curve.csv", LIVE)
_KNOWN: dict[str, tuple[type, ...]] = {  # of live.json, what may have which type
    **dict.fromkeys(("evaluations", "budget", "workers", "busy", "failures"), (int,)),
    **dict.fromkeys(("seconds", "best_loss"), (int, float)),
    "sentence": (str,),
}


class RunFiles:
    """Files of one run directory, by a fixed list of names."""

    def __init__(self, directory: str | os.PathLike[str]) -> None:
        self.path = Path(directory)
        self._known: tuple[Any, dict[str, Any]] = (None, {})  # the curve, and of which file

    def picture(self, name: str) -> bytes | None:
        """PNG of that name in `PICTURES`; None if there is none."""
        data = self._read(name)
        return data if data is not None and _is_picture(data) else None

    def state(self) -> dict[str, Any]:
        """Everything the page shows, as JSON has it; what is not known is absent."""
        run = self._json("run.json")
        settings = run.get("settings")
        settings = settings if isinstance(settings, dict) else {}
        shown: dict[str, Any] = {
            "state": _text(run.get("state", "not begun")),
            "task": _text(settings.get("task", self.path.name)),
            "optimizer": _text(settings.get("optimizer", "")),
            "loss": _text(settings.get("loss", "loss")),
            "pictures": {name: str(mark[0]) for name in PICTURES if (mark := self._mark(name))},
        }
        totals = run.get("totals")
        under_way = shown["state"] == "running"  # then totals are those of an earlier call
        if isinstance(totals, dict) and not under_way:
            shown["sentence"] = _text(totals.get("sentence", ""))
        live = self._json(LIVE)
        curve = self._curve()
        newest = max(curve, live, key=lambda one: _whole(one.get("evaluations")))
        shown |= _checked(curve) | _checked(live) | _checked(newest)
        points = curve.get("improvements", [])
        newest_point = [shown.get("evaluations"), shown.get("best_loss")]
        if None not in newest_point and (not points or newest_point[1] != points[-1][1]):
            points = [*points, newest_point]
        step = 1 + len(points) // _MOST_POINTS
        shown["improvements"] = [*points[:-1:step], *points[-1:]]
        shown["parameters"] = _rows(live.get("parameters"))
        if not shown["parameters"] and not under_way:
            shown["parameters"] = _rows(_found(totals))
        if shown["state"] == "running" and self._has_stopped():
            shown["state"] = "stopped without an end; continue with --resume"
        if shown["state"] != "running":
            shown.pop("busy", None)
        return shown

    def _has_stopped(self) -> bool:
        """Whether the process of a run was killed: its lock is free, and nothing is written."""
        marks = (self._mark(name) for name in _WRITTEN)
        newest = max((mark[0] for mark in marks if mark), default=0) / 1e9
        return time.time() - newest > _QUIET and is_under_way(self.path) is False

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

    def _json(self, name: str) -> dict[str, Any]:
        try:
            found = json.loads(self._read(name, _MOST_OF_JSON) or b"{}")
        except (ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) else {}

    def _curve(self) -> dict[str, Any]:
        """What `curve.csv` says, read again when it has changed."""
        mark = self._mark("curve.csv")
        if self._known[0] != mark:
            self._known = mark, _curve_of(self._read("curve.csv") or b"")
        return self._known[1]


def _curve_of(data: bytes) -> dict[str, Any]:
    lines = csv.DictReader(io.TextIOWrapper(io.BytesIO(data), "utf-8", "replace", newline=""))
    improvements: list[list[float]] = []
    number, seconds = 0, 0.0
    try:
        for number, row in enumerate(lines, 1):
            best, seconds = float(row["best_loss"]), float(row["seconds"])
            if math.isfinite(best) and (not improvements or best < improvements[-1][1]):
                improvements.append([number, best])
    except (KeyError, TypeError, ValueError, csv.Error):
        return {}
    if not improvements or not math.isfinite(seconds):
        return {}
    known = {"evaluations": number, "best_loss": improvements[-1][1], "seconds": seconds}
    return {**known, "improvements": improvements}


def _is_picture(data: bytes) -> bool:
    """Whether it begins as a PNG that may be decoded: a few bytes may say billions of pixels."""
    if not data.startswith(_PNG) or len(data) < len(_PNG) + _SIZE.size:
        return False
    width, height = _SIZE.unpack_from(data, len(_PNG))
    return bool(width * height <= MAX_PIXELS)


def _text(value: Any) -> str:
    return str(value)[:300]


def _whole(value: Any) -> int:
    return value if isinstance(value, int) else -1


def _checked(live: dict[str, Any]) -> dict[str, Any]:
    """Entries of `live.json` that have the right type, and are numbers that a page can show."""
    right = {k: live[k] for k, types in _KNOWN.items() if type(live.get(k)) in types}
    return {k: v for k, v in right.items() if isinstance(v, str) or abs(v) < 2**53}


def _found(totals: Any) -> list[list[Any]]:
    """Parameters that a run which has ended has found."""
    params = totals.get("params") if isinstance(totals, dict) else None
    try:
        pairs = flat(params) if isinstance(params, dict) else []
    except RecursionError:
        return []
    return [[k, f"{v:.5g}" if isinstance(v, float) else v, ""] for k, v in pairs]


def _rows(value: Any) -> list[list[str]]:
    if not isinstance(value, list):
        return []
    rows = [row for row in value if isinstance(row, list) and len(row) == 3]
    return [[_text(cell) for cell in row] for row in rows[:_MOST_POINTS]]
