"""By what a renderer is known again: a model that was learned of another one is of little use."""

from __future__ import annotations

import hashlib
import inspect
import tokenize

__all__ = ["changed", "digest", "fingerprint_of"]


def fingerprint_of(render: object) -> str | None:
    """Kind and digest of what a renderer says of itself, or of the source of a function.

    That of a `FunctionRenderer` is of its file, that of a `CommandRenderer` of its command lines;
    what a file imports, and what a program reads, is not known.  None: nothing is known.
    """
    own = getattr(render, "fingerprint", None)
    if own is None and inspect.isfunction(render):
        try:
            own = digest("function", inspect.getsource(render).encode())
        except (OSError, TypeError, SyntaxError, tokenize.TokenError):
            return None  # the file is gone, or has changed since
    return own if isinstance(own, str) else None


def digest(kind: str, data: bytes) -> str:
    """Fingerprint of that kind; only those of one kind are compared."""
    return f"{kind}:{hashlib.sha256(data).hexdigest()[:16]}"


def changed(one: str | None, other: str | None) -> bool:
    """Whether two fingerprints are known to be of different renderers."""
    if one is None or other is None or one.partition(":")[0] != other.partition(":")[0]:
        return False
    return one != other
