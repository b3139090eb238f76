"""A space as a file in TOML: a table for each parameter, see `dictionary`."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

from fide_plugins.errors import SpaceError
from fide_plugins.runtime.files import write_text

__all__ = ["parse", "read", "text", "write"]


_MOST_BYTES = 2**24  # 200,000 parameters


def parse(text: str) -> dict[str, Any]:
    """Tables of a text; SpaceError if it is no TOML."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also a number of 5,000 digits, deep brackets
        raise SpaceError(f"no TOML: {error}; write [name] and below it key = value") from None


def read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Tables of a file, or of a pipe; SpaceError if it is no TOML, OSError if it cannot be read."""
    with open(path, "rb") as file:
        data = file.read(_MOST_BYTES + 1)
    if len(data) > _MOST_BYTES:
        raise SpaceError(f"it has more than {_MOST_BYTES:,} bytes; name the file of a space")
    try:
        return parse(data.decode("utf-8-sig"))  # Windows begins files with a mark
    except UnicodeDecodeError as error:
        raise SpaceError(f"no TOML: {error}; save it as UTF-8") from None


def write(path: str | os.PathLike[str], data: Mapping[str, Any]) -> None:
    """Write the file, whole or not at all."""
    write_text(path, text(data))


def text(data: Mapping[str, Any]) -> str:
    """Tables as a text."""
    return "\n".join(_table((key,), value) for key, value in data.items())


def _table(path: tuple[str, ...], data: Mapping[str, Any]) -> str:
    inner = {key: value for key, value in data.items() if isinstance(value, Mapping)}
    own = {key: value for key, value in data.items() if key not in inner}
    lines = [f"[{'.'.join(map(_key, path))}]", *_lines(path, own)]
    tables = [_table((*path, key), value) for key, value in inner.items()]
    return "\n".join(["\n".join(lines) + "\n", *tables])


def _lines(path: tuple[str, ...], data: Mapping[str, Any]) -> Iterator[str]:
    for key, value in data.items():
        if isinstance(value, list):
            inside = ", ".join(_value(path, each) for each in value)
            yield f"{_key(key)} = [{inside}]"
        else:
            yield f"{_key(key)} = {_value(path, value)}"


def _key(key: str) -> str:
    return key if key.isascii() else _quoted(key)


def _value(path: tuple[str, ...], value: Any) -> str:
    if value is None:
        raise SpaceError(f"[{'.'.join(path)}] holds None, which TOML cannot; use the text 'none'")
    if isinstance(value, str):
        return _quoted(value)
    return json.dumps(value) if isinstance(value, bool) else repr(value)


def _quoted(value: str) -> str:
    """Return a text as TOML has it, which escapes as JSON does, and DEL."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
