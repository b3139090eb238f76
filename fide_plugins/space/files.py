"""A space as plain dictionaries, lists, texts and numbers, for JSON, and as a file in TOML.

    {"azimuth": {"type": "float", "low": -60.0, "high": 60.0, "unit": "deg", "periodic": true},
     "floor": {"type": "choice", "values": ["checker", "wood"]},
     "beads": {"repeat": 6, "x": {"type": "float", "low": 0.0, "high": 1.0}}}

What has a key besides tables and "repeat" is a parameter, all else is a group.  Without a "type" it
is a choice if it has "values", and else a float.  Keys that are as by default are left out.
"""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from fide_plugins.errors import SpaceError, did_you_mean
from fide_plugins.space.group import Group, Member, Repeated
from fide_plugins.space.kinds import Choice, Float, Int, Kind

__all__ = ["from_dict", "parse_toml", "read_toml", "to_dict", "to_toml"]

_KINDS: dict[str, type[Kind]] = {kind.type: kind for kind in (Float, Int, Choice)}
_PLAIN = (str, int, float, bool, type(None))
_MOST_BYTES = 2**24  # of a file: 200,000 parameters


def to_dict(members: Mapping[str, Member], prefix: str = "") -> dict[str, Any]:
    """Plain data of the members of a space or group."""
    return {key: _data(prefix + key, member) for key, member in members.items()}


def _data(name: str, member: Member) -> dict[str, Any]:
    if isinstance(member, Repeated):
        return {"repeat": member.times, **to_dict(member.group.members, f"{name}.")}
    if isinstance(member, Group):
        return to_dict(member.members, f"{name}.")
    if isinstance(member, Choice):
        values = [_plain(f"parameter {name!r}", value) for value in member.values]
        return {"type": "choice", "values": values}
    given = {each.name: getattr(member, each.name) for each in fields(member)}
    defaults = {each.name: each.default for each in fields(member)}
    return {"type": member.type} | {k: v for k, v in given.items() if v != defaults[k]}


def _plain(where: str, value: Any) -> Any:
    """A value of a choice; SpaceError for one that files cannot hold."""
    value = value.item() if isinstance(value, np.generic) else value
    if type(value) not in _PLAIN:
        raise SpaceError(
            f"{where} has the value {value!r}, which files cannot hold; use texts and look the "
            "objects up by them"
        )
    return value


def from_dict(data: object) -> dict[str, Member]:
    """Members of a space; SpaceError naming table and key if it is none."""
    if not isinstance(data, Mapping) or not data:
        raise SpaceError(
            f"a space must be a dictionary of parameters, at least one, not {data!r}; write a "
            "table for each, such as [x] with low = 0, high = 1"
        )
    try:
        return _members(data, "")
    except RecursionError:
        raise SpaceError("tables are nested too deeply; write fewer groups in each other") from None


def _members(data: Mapping[str, Any], prefix: str) -> dict[str, Member]:
    return {key: _member(f"{prefix}{key}", value) for key, value in data.items()}


def _member(table: str, data: object) -> Member:
    try:
        if not isinstance(data, Mapping) or not data:
            raise SpaceError(
                f"must be a table, not {data!r}; write [{table}] and below it low = 0, high = 1"
            )
        own = {key for key, value in data.items() if not isinstance(value, Mapping)}
        return _parameter(data) if own - {"repeat"} else _group(table, data)
    except SpaceError as error:
        if str(error).startswith("["):  # an inner table has said where
            raise
        raise SpaceError(f"[{table}] {error}") from None


def _parameter(data: Mapping[str, Any]) -> Kind:
    name = data.get("type", "choice" if "values" in data else "float")
    if not isinstance(name, str) or name not in _KINDS:
        hint = did_you_mean(name, _KINDS)
        raise SpaceError(f"type: must be one of {', '.join(_KINDS)}, not {name!r}{hint}")
    kind = _KINDS[name]
    known = ["type", *(each.name for each in fields(kind))]
    for key in data:
        if key not in known:
            hint = did_you_mean(key, known)
            raise SpaceError(f"{key}: unknown key; {name} has {', '.join(known)}{hint}")
    for key in ("values",) if kind is Choice else ("low", "high"):
        if key not in data:
            raise SpaceError(f"{key}: missing; write {key} = ... below it")
    values = {key: value for key, value in data.items() if key != "type"}
    if kind is not Choice:
        return kind(**values)
    listed = values["values"]
    if not isinstance(listed, list | tuple):
        raise SpaceError(f'values: must be a list such as ["a", "b"], not {listed!r}')
    return Choice(*(_plain("values:", value) for value in listed))


def _group(table: str, data: Mapping[str, Any]) -> Group | Repeated:
    members = {key: value for key, value in data.items() if key != "repeat"}
    if not members:
        raise SpaceError(f"is empty; write low = 0, high = 1 below it, or tables [{table}.NAME]")
    group = Group(_members(members, f"{table}."))
    return group * data["repeat"] if "repeat" in data else group


# -- TOML ------------------------------------------------------------------------------------------


def parse_toml(text: str) -> dict[str, Any]:
    """Tables of a text; SpaceError if it is no TOML."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also a number of 5,000 digits, deep brackets
        raise SpaceError(f"no TOML: {error}; write [name] and below it key = value") from None


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Tables of a file, or of a pipe; SpaceError if it is no TOML, OSError if it cannot be read."""
    with open(path, "rb") as file:
        data = file.read(_MOST_BYTES + 1)
    if len(data) > _MOST_BYTES:
        raise SpaceError(f"it has more than {_MOST_BYTES:,} bytes; name the file of a space")
    try:
        return parse_toml(data.decode("utf-8-sig"))  # Windows begins files with a mark
    except UnicodeDecodeError as error:
        raise SpaceError(f"no TOML: {error}; save it as UTF-8") from None


def to_toml(data: Mapping[str, Any]) -> str:
    """Tables as a text."""
    return "\n".join(_table((key,), value) for key, value in data.items())


def _table(path: tuple[str, ...], data: Mapping[str, Any]) -> str:
    inner = {key: value for key, value in data.items() if isinstance(value, Mapping)}
    name = ".".join(key if key.isascii() else _value(path, key) for key in path)
    own = [
        f"{key if key.isascii() else _value(path, key)} = {_value(path, value)}\n"
        for key, value in data.items()
        if key not in inner
    ]
    tables = [_table((*path, key), value) for key, value in inner.items()]
    return "\n".join(["".join([f"[{name}]\n", *own]), *tables])


def _value(path: tuple[str, ...], value: Any) -> str:
    """A value as TOML has it, which escapes texts as JSON does, and DEL."""
    if isinstance(value, list):
        return f"[{', '.join(_value(path, each) for each in value)}]"
    if value is None:
        raise SpaceError(f"[{'.'.join(path)}] holds None, which TOML cannot; use the text 'none'")
    if isinstance(value, str | bool):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
