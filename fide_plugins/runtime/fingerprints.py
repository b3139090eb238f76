"""Fingerprints of what users wrote, each with its kind, such as "file:0123456789abcdef"."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

__all__ = ["changed", "kind_of", "of_bytes", "of_file"]


def of_bytes(kind: str, data: bytes) -> str:
    """Fingerprint of that kind: its name and 16 hexadecimal digits of SHA-256."""
    return f"{kind}:{hashlib.sha256(data).hexdigest()[:16]}"


def of_file(path: str | os.PathLike[str]) -> str | None:
    """Fingerprint of the contents of a file, of the kind "file"; None if it cannot be read."""
    try:
        return of_bytes("file", Path(path).read_bytes())
    except OSError:
        return None


def kind_of(one: str) -> str:
    """Kind of a fingerprint; only those of one kind are compared."""
    return one.partition(":")[0]


def changed(one: str | None, other: str | None) -> bool:
    """Whether two fingerprints are known to be of different things."""
    if one is None or other is None or kind_of(one) != kind_of(other):
        return False
    return one != other
