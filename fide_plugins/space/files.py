"""A space as plain dictionaries, lists, texts and numbers, for JSON, and as a file in TOML.

    {"azimuth": {"type": "float", "low": -60.0, "high": 60.0, "unit": "deg", "periodic": true},
     "floor": {"type": "choice", "values": ["checker", "wood"]},
     "beads": {"repeat": 6, "x": {"type": "float", "low": 0.0, "high": 1.0}}}

What has a key of a parameter is one, all else is a group.  Without a "type" it is a choice if it
has "values", and else a float.  `to_dict` writes it, and leaves out keys that are as by default.
Conditions on the parameters are the table "constraints", a text for each name (`expressions`).
"""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fide_plugins.errors import SpaceError, did_you_mean
from fide_plugins.space.group import Group, Member, Repeated
from fide_plugins.space.kinds import Choice, Float, Int, Kind, is_synonym, right_word

__all__ = ["from_dict", "parse_toml", "read_toml", "to_dict", "to_toml"]

_KINDS = {kind.type: kind for kind in (Float, Int, Choice)}
_KEYS = {
    "float": ("low", "high", "unit", "log", "periodic", "step"),
    "int": ("low", "high", "unit", "log", "step"),
    "choice": ("values",),
}
_PLAIN = (str, int, float, bool, type(None))
_REQUIRED = {"float": ("low", "high"), "int": ("low", "high"), "choice": ("values",)}
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
    fields = member.__dataclass_fields__
    given = {key: getattr(member, key) for key in _KEYS[member.type]}
    return {"type": member.type} | {k: v for k, v in given.items() if v != fields[k].default}


def _plain(where: str, value: Any) -> Any:
    value = value.item() if isinstance(value, np.generic) else value
    if type(value) not in _PLAIN:
        raise SpaceError(
            f"{where} has the value {value!r}, which files cannot hold; use texts and look the "
            "objects up by them"
        )
    return value


def _read(value: Any) -> Any:
    """A value of a choice; SpaceError for one that `to_dict` could not give back."""
    value = value.item() if isinstance(value, np.generic) else value
    if type(value) not in _PLAIN:
        raise SpaceError(
            f"values: must be texts, numbers or booleans, not {value!r}; write a text, and look "
            "the object up by it"
        )
    return value


def from_dict(data: object) -> dict[str, Member]:
    """Members of a space; SpaceError naming table and key if it is none."""
    if not isinstance(data, Mapping):
        raise SpaceError(f"a space must be a dictionary of parameters, not {data!r}")
    if not data:
        raise SpaceError(
            "Space needs at least one parameter; write a table for each, such as [x] with low = 0, "
            "high = 1"
        )
    try:
        return _members(data, "")
    except RecursionError:
        raise SpaceError("tables are nested too deeply; write fewer groups in each other") from None


def _members(data: Mapping[str, Any], prefix: str) -> dict[str, Member]:
    return {key: _member(f"{prefix}{key}", value) for key, value in data.items()}


def _member(table: str, data: object) -> Member:
    if not isinstance(data, Mapping):
        raise SpaceError(
            f"[{table}] must be a table, not {data!r}; write [{table}] and below it low = 0, "
            "high = 1"
        )
    try:
        return _parameter(data) if _is_parameter(data) else _group(table, data)
    except SpaceError as error:
        if str(error).startswith("["):  # an inner table has said where
            raise
        raise SpaceError(f"[{table}] {error}") from None


def _is_parameter(data: Mapping[str, Any]) -> bool:
    """Whether a table is a parameter, perhaps one without its type, or with a misspelt key."""
    known = {key for keys in _KEYS.values() for key in keys}
    own = [key for key, value in data.items() if not isinstance(value, Mapping)]
    return any(key == "type" or key in known or is_synonym(key) for key in own)


def _parameter(data: Mapping[str, Any]) -> Kind:
    kind = data.get("type", "choice" if "values" in data else "float")
    if not isinstance(kind, str) or kind not in _KINDS:
        hint = right_word(kind, _KINDS)
        raise SpaceError(
            f"type: unknown type {kind!r}; write type = one of {', '.join(map(repr, _KINDS))}{hint}"
        )
    keys = dict.fromkeys(("type", *_KEYS[kind]))
    for key in data:
        if key not in keys:
            others = [other for other in _KINDS if key in _KEYS[other]]
            hint = f"; did you mean type = {others[0]!r}?" if len(others) == 1 else ""
            hint = hint or right_word(key, keys)
            article = "an" if kind == "int" else "a"
            raise SpaceError(
                f"{key}: unknown key of {article} {kind}; known are {', '.join(keys)}{hint}"
            )
    for key in _REQUIRED[kind]:
        if key not in data:
            raise SpaceError(f"{key}: missing; a {kind} needs {' and '.join(_REQUIRED[kind])}")
    values = {key: value for key, value in data.items() if key != "type"}
    if kind == "choice":
        if not isinstance(values["values"], list | tuple):
            raise SpaceError(f'values: must be a list such as ["a", "b"], not {values["values"]!r}')
        return Choice(*(_read(value) for value in values["values"]))
    return _KINDS[kind](**values)


def _group(table: str, data: Mapping[str, Any]) -> Group | Repeated:
    members = {key: value for key, value in data.items() if key != "repeat"}
    for key, value in members.items():
        if not isinstance(value, Mapping):
            known = dict.fromkeys(("type", "repeat", "low", "high", "values"))
            raise SpaceError(
                f"{key}: a group holds tables and repeat, not {value!r}; write [{table}.{key}]"
                f"{did_you_mean(key, known)}"
            )
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
