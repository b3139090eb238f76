"""Fingerprints of what users wrote, each with its kind, such as "file:0123456789abcdef".

A renderer is known again by a version, which the user states, or else by a fingerprint of its
source: a model that was learned of another one is of little use.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import tokenize
from pathlib import Path

from fide_plugins.errors import OptionError
from fide_plugins.runtime.callables import own_name

__all__ = [
    "changed",
    "check_version",
    "fingerprint_of",
    "kind_of",
    "of_bytes",
    "of_file",
    "version_of",
]


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


def version_of(render: object) -> str | None:
    """Version that a renderer states: the attribute `version` of the function or the object.

    None: it states none.  A method of that name states none, either.  Raises OptionError for
    anything else than a text, so that nobody relies on a version that would not count.
    """
    own = getattr(render, "version", None)
    return None if callable(own) else check_version(own, f"the version of {own_name(render)}")


def check_version(version: object, what: str) -> str | None:
    """Return a version that is a text, or None; raises OptionError, beginning with `what`."""
    if version is not None and not (isinstance(version, str) and version):
        raise OptionError(f"{what} is a text such as '2', or None, not {version!r}")
    return version


def fingerprint_of(render: object) -> str | None:
    """Kind and digest of what a renderer says of itself, or of the source of a function.

    That of a `FunctionRenderer` is of its file, that of a `CommandRenderer` of its command lines;
    what a file imports, and what a program reads, is not known.  None: nothing is known.
    """
    own = getattr(render, "fingerprint", None)
    if own is None and inspect.isfunction(render):
        try:
            own = of_bytes("function", inspect.getsource(render).encode())
        except (OSError, TypeError, SyntaxError, tokenize.TokenError):
            return None  # the file is gone, or has changed since
    return own if isinstance(own, str) else None
