"""The command line of a program, with placeholders for parameters.

=====================  =====================================================================
placeholder            is replaced by
=====================  =====================================================================
``{out}``              path of the image to write, which ends with .png
``{out:.tif}``         the same with another ending
``{azimuth}``          value of a parameter
``{azimuth:.3f}``      the same in a format of Python's `format`
``{beads[0].x}``       a parameter of a group, by its flat name (`Space.names`)
``{params}``           path of a JSON file with all parameters
``{{`` and ``}}``      braces
=====================  =====================================================================

The template is split into arguments before values are filled in, and there is no shell: a value
is always one argument, or a piece of one, whatever it contains.
"""

from __future__ import annotations

import os
import shlex
import shutil
import string
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

from fide_plugins.errors import OptionError
from fide_plugins.renderers.naming import flat
from fide_plugins.space import Choice, Space

__all__ = ["Template"]

_FILES = ("out", "params")  # placeholders that are no parameters
_SHELL = ("|", "||", "&", "&&", ";", ">", ">>", "<", "2>", "2>&1", "&>")


class Template:
    """Command line for the parameters of a space.

    Raises OptionError (a ValueError) if it is empty or cannot be split, has no ``{out}``, has a
    placeholder that is neither a parameter nor a file, a format that a value of a choice does not
    fit, holds words for a shell, or if its program is not on this machine.
    """

    def __init__(self, text: str, space: Space) -> None:
        self.text = text
        self._space = space
        self.words = _words(text)
        for name in _FILES:
            if name in space.names:
                raise OptionError(
                    f"no parameter of a command may be called {name!r}, which is the name of a "
                    f"file in it; call it {name}_"
                )
        fields = [field for word in self.words for field in _fields(word, text)]
        self.used = {name for name, _, _ in fields}
        _check_names(self.used, space, text)
        _check_words(self.words)
        _check_choices(fields, space, text)
        self.suffix = next((spec for name, spec, _ in fields if name == "out" and spec), ".png")
        """Ending of the image's name."""

    def command(self, params: Mapping[str, Any], out: str, params_file: str) -> list[str]:
        """Arguments, the program first, for these parameters and files.

        Raises OptionError if a value does not fit the format that is asked for.
        """
        values = dict(flat(params))
        return [self._fill(word, values, out, params_file) for word in self.words]

    def _fill(self, word: str, values: Mapping[str, Any], out: str, params_file: str) -> str:
        filled = []
        for literal, name, spec, conversion in string.Formatter().parse(word):
            filled.append(literal)
            if name is None:
                continue
            key = _flat_name(name)
            if key in _FILES:
                filled.append(out if key == "out" else params_file)
            else:
                filled.append(_formatted(key, values[key], spec or "", conversion, self.text))
        return "".join(filled)


def _words(text: str) -> list[str]:
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise OptionError(f"the command cannot be split ({error}): {text!r}") from None
    if not words:
        raise OptionError("the command is empty; write the program and its arguments")
    return words


def _fields(word: str, text: str) -> list[tuple[str, str, str | None]]:
    """Flat name, format and conversion of each placeholder in a word."""
    try:
        parsed = list(string.Formatter().parse(word))
    except ValueError as error:
        raise OptionError(
            f"the placeholders of the command cannot be read ({error}) in {word!r}; write {{{{ and "
            "}} for braces"
        ) from None
    if any(spec and "{" in spec for _, _, spec, _ in parsed):
        raise OptionError(f"no placeholder may be inside another one, as in {word!r}: {text!r}")
    return [(_flat_name(name), spec or "", c) for _, name, spec, c in parsed if name is not None]


def _flat_name(field: str) -> str:
    """Flat name of a placeholder, which may also be written beads[0][x].

    >>> _flat_name("beads[0][x]"), _flat_name("beads[0].x"), _flat_name("ball[x]")
    ('beads[0].x', 'beads[0].x', 'ball.x')
    """
    first, *keys = field.replace("]", "").split("[")
    parts = [first]
    for key in keys:
        number, dot, rest = key.partition(".")
        parts.append(f"[{number}]{dot}{rest}" if number.isdecimal() else f".{key}")
    return "".join(parts)


def _check_names(used: set[str], space: Space, text: str) -> None:
    known = [*_FILES, *space.names]
    for name in sorted(used):
        if name not in known:
            close = get_close_matches(name, known, n=1)
            hint = f"; did you mean {{{close[0]}}}?" if close else ""
            raise OptionError(
                f"{{{name}}} in the command is no parameter of the space; known are "
                f"{', '.join(known)}{hint}"
            )
    if "out" not in used:
        raise OptionError(
            f"the command has no {{out}}, so the image would not be found: {text!r}; put {{out}} "
            "where the program expects the name of the image"
        )


def _check_choices(fields: list[tuple[str, str, str | None]], space: Space, text: str) -> None:
    """Raise OptionError unless every value of a choice fits its format.

    Each of its renders would fail, and a search would leave that value out.
    """
    parameters = space.parameters
    for name, spec, conversion in fields:
        kind = parameters.get(name)
        for value in kind.values if isinstance(kind, Choice) else ():
            _formatted(name, value, spec, conversion, text)


def _check_words(words: list[str]) -> None:
    for word in words:
        if word in _SHELL:
            raise OptionError(
                f"{word!r} would be an argument, because no shell reads the command; put such a "
                "line into a script, and make the script the command"
            )
    program = words[0]
    if "{" not in program and shutil.which(program) is None:
        raise OptionError(_no_program(program))


def _no_program(program: str) -> str:
    """Why a program cannot be run, and what to do."""
    if program.startswith("~"):
        return f"no shell reads the command, so ~ is no folder in {program!r}; write the whole path"
    if os.sep in program and os.path.isfile(program):
        return (
            f"{program!r} is a file that may not be executed; allow it (chmod +x), or write the "
            "program that runs it first, such as sh or python"
        )
    where = "in the folder" if os.sep in program else "on the PATH"
    return (
        f"no program {program!r} {where}; install it, or write its whole path "
        f"(looked from {os.getcwd()})"
    )


def _formatted(name: str, value: Any, spec: str, conversion: str | None, text: str) -> str:
    if conversion is not None:
        value = repr(value) if conversion == "r" else str(value)
    try:
        return format(value, spec)
    except (ValueError, TypeError) as error:
        raise OptionError(
            f"{{{name}:{spec}}} in the command does not fit the value {value!r} ({error}): "
            f"{text!r}; take a format that all of its values fit, or write {{{name}}}"
        ) from None
