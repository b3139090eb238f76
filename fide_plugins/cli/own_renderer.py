"""A renderer of one's own, as the command line names it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from fide_plugins.errors import OptionError

if TYPE_CHECKING:
    from fide_plugins.renderers import CommandRenderer, FunctionRenderer
    from fide_plugins.space import Space

__all__ = ["function_of", "program_of", "space_of"]


def space_of(file: str | None) -> Space | None:
    """Space in the file that --space names; None without it."""
    from fide_plugins.space import Space

    try:
        return None if file is None else Space.read(file)
    except FileNotFoundError as error:
        raise OptionError(
            f"--space: there is no file {file!r}; name a TOML file with a table for each parameter "
            "(docs/reference/space.md)"
        ) from error
    except IsADirectoryError as error:
        raise OptionError(f"--space: {file!r} is a folder; name the TOML file in it") from error


def function_of(reference: str, space: Space | None) -> tuple[FunctionRenderer, Space | int]:
    """Function ``FILE.py:NAME``, and its parameters: `space`, or else what is beside it."""
    from fide_plugins.renderers import FunctionRenderer

    function = FunctionRenderer(reference)
    return function, function.space_or(space)


def program_of(
    templates: str | Sequence[str], space: Space | None, timeout: float, raw: bool = False
) -> tuple[CommandRenderer, Space]:
    """Program of a command, or of one for each view, and its parameters.

    timeout: seconds until it is stopped.  raw: whether it has a range of values.
    """
    from fide_plugins.renderers import CommandRenderer

    if space is None:
        raise OptionError("--command needs --space FILE.toml, the parameters and their ranges")
    return CommandRenderer(templates, space, timeout, raw), space
