"""By what a renderer is known again: a model that was learned of another one is of little use.

A version, which the user states, or else a fingerprint of the source.
"""

from __future__ import annotations

import inspect
import tokenize

from fide_plugins.errors import OptionError
from fide_plugins.runtime import fingerprints
from fide_plugins.runtime.callables import own_name

__all__ = ["check_version", "fingerprint_of", "version_of"]


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
            own = fingerprints.of_bytes("function", inspect.getsource(render).encode())
        except (OSError, TypeError, SyntaxError, tokenize.TokenError):
            return None  # the file is gone, or has changed since
    return own if isinstance(own, str) else None
