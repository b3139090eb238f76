"""Schemas: types, ranges and shapes of a state that was read from a file, by name of each side.

A rule returns what it has checked as it is put back: a dataclass, an enum, a tensor.

>>> _ = check({"x": np.zeros((3, 2)), "n": 3}, {"x": array("n", "d"), "n": whole()}, {"d": 2})
>>> check({"x": np.zeros((3, 2)), "n": 3}, {"x": array("n", "n"), "n": whole()}, {})
Traceback (most recent call last):
ValueError: state['x'] has the shape (3, 2), and n is 3
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import field, fields, is_dataclass
from enum import Enum
from typing import Any, ClassVar, TypeAlias

import numpy as np

Sides: TypeAlias = dict[str, Any]
"""Lengths of sides by their names; "device": of tensors that are put back."""
Plain: TypeAlias = Mapping[str, Any]
"""What `state_dict` gives: arrays, tensors, numbers, texts, in lists and dicts."""
Rule: TypeAlias = Callable[[Any, str, Sides], Any]
Schema: TypeAlias = "Rule | dict[str, Schema]"

IMPOSSIBLE = (
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""Errors that may occur when an impossible state is used."""
_LARGEST = sys.float_info.max  # a legal value: some libraries use it for a failed evaluation


def check(state: Any, schema: Schema, sides: Sides, place: str = "state") -> Any:
    """Return what is put back; ValueError unless `state` matches the schema.

    Adds the sides found to `sides`.
    """
    if not isinstance(schema, dict):
        return schema(state, place, sides)
    _demand(isinstance(state, dict), place, "is no dict")
    odd = sorted(set(state) ^ set(schema))
    _demand(not odd, place, f"has missing or unknown entries: {', '.join(map(repr, odd))}")
    return {k: check(state[k], one, sides, f"{place}[{k!r}]") for k, one in schema.items()}


def saved(rule: Schema, **arguments: Any) -> Any:
    """Field of a dataclass that is saved, and what it must be like; arguments: of `field`."""
    return field(metadata={"saved": rule}, **arguments)


def form(kind: type) -> dict[str, Schema]:
    """Return the schema of the `saved` fields of a dataclass, by name."""
    return {f.name: f.metadata["saved"] for f in fields(kind) if "saved" in f.metadata}


def packed(value: Any) -> Any:
    """A part, or a list of them, as plain values, not copies; anything else as it is."""
    if isinstance(value, list | tuple | deque):
        return [packed(one) for one in value]
    if hasattr(value, "state_dict"):
        return value.state_dict()
    fields_of = form(type(value)) if is_dataclass(value) else {}
    return {name: packed(getattr(value, name)) for name in fields_of} if fields_of else value


class Stateful:
    """An object that saves its `saved` fields, or those of its attributes that are in SCHEMA.

    SCHEMA: what each must be like, by name; a private attribute is there without its underscore.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {}

    def state_dict(self) -> dict[str, Any]:
        """All that changes, those values in use, not copies; parts by their own `state_dict`."""
        return {name: packed(getattr(self, self._attribute(name))) for name in self._schema()}

    def load_state_dict(self, state: Plain, sides: Sides | None = None) -> None:
        """Put back what `state_dict` gave; ValueError for what it cannot have given.

        sides: of arrays, by their names in the schema, as far as they are known.
        """
        known = {**(sides or {}), **self._sides()}
        found = check(state, self._schema(), known, type(self).__name__.lower())
        for name, value in found.items():
            part = getattr(self, self._attribute(name))
            if hasattr(part, "load_state_dict"):
                part.load_state_dict(value, known)
            elif isinstance(part, list) and part and hasattr(part[0], "load_state_dict"):
                for one, its in zip(part, value, strict=True):
                    one.load_state_dict(its, known)
            else:
                setattr(self, self._attribute(name), value)

    def _schema(self) -> dict[str, Schema]:
        return self.SCHEMA or form(type(self))

    def _sides(self) -> Sides:
        """Sides that this object knows."""
        return {}

    def _attribute(self, name: str) -> str:
        return f"_{name}" if hasattr(self, f"_{name}") else name


def _demand(sound: bool, place: str, otherwise: str) -> None:
    if not sound:
        raise ValueError(f"{place} {otherwise}")


def _rule(sound: Callable[[Any], bool], otherwise: str) -> Rule:
    def rule(value: Any, place: str, sides: Sides) -> Any:
        _demand(sound(value), place, otherwise)
        return value

    return rule


def _is_number(value: Any, kinds: Any, low: float, high: float) -> bool:
    return isinstance(value, kinds) and not isinstance(value, bool) and low <= value <= high


def whole(low: int = 0, high: int = 2**63) -> Rule:
    """An int within [low, high]."""
    return _rule(lambda v: _is_number(v, int, low, high), f"is no whole number in [{low}, {high}]")


def real(low: float = -_LARGEST, high: float = _LARGEST) -> Rule:
    """A number within [low, high]."""
    otherwise = f"is no number in [{low}, {high}]"
    return _rule(lambda v: _is_number(v, int | float, low, high), otherwise)


def anything(value: Any, place: str, sides: Sides) -> Any:
    """Any value: for a component that checks its own state."""
    return value


flag = _rule(lambda v: isinstance(v, bool), "is neither True nor False")
text = _rule(lambda v: isinstance(v, str), "is no text")


def array(
    *names: str | int,
    kind: str = "f",
    low: float | None = -_LARGEST,
    high: float = _LARGEST,
) -> Rule:
    """An array with these sides, of NumPy's dtype kind `kind`, with values within [low, high].

    low None: any values, also NaN.  An array without rows may lack the other sides.
    """

    def rule(given: Any, place: str, sides: Sides) -> Any:
        value = _on_this_machine(given)
        sound = isinstance(value, np.ndarray) and value.dtype.kind in kind
        _demand(sound, place, f"is no array of the kind {kind!r}")
        rows = names[0] if isinstance(names[0], int) else sides.get(names[0], 0)
        empty = value.shape[:1] == (0,) and rows == 0
        _demand(empty or value.ndim == len(names), place, f"has the shape {value.shape}")
        for name, side in zip(names[:1] if empty else names, value.shape, strict=False):
            known = name if isinstance(name, int) else sides.setdefault(name, side)
            _demand(side == known, place, f"has the shape {value.shape}, and {name} is {known}")
        if value.size and kind != "b" and low is not None:
            ends = float(value.min()), float(value.max())  # NaN if there is one
            _demand(low <= ends[0] <= ends[1] <= high, place, f"has values outside [{low}, {high}]")
        return given

    return rule


def tensor(*names: str) -> Rule:
    """Such an array, which becomes a tensor on the device of the sides."""
    rule = array(*names)

    def made(value: Any, place: str, sides: Sides) -> Any:
        from torch import as_tensor

        return as_tensor(rule(value, place, sides), device=sides.get("device"))

    return made


def instance(kind: Callable[..., Any], schema: Schema | None = None) -> Rule:
    """What `kind` makes of these fields; None: the `saved` ones of a dataclass."""

    def rule(value: Any, place: str, sides: Sides) -> Any:
        own = form(kind) if schema is None and isinstance(kind, type) else schema or {}
        return kind(**check(value, own, sides, place))

    return rule


def enum(kind: type[Enum]) -> Rule:
    """The value of a member."""

    def rule(value: Any, place: str, sides: Sides) -> Any:
        _demand(value in [one.value for one in kind], place, f"is no {kind.__name__}")
        return kind(value)

    return rule


def _on_this_machine(value: Any) -> Any:
    """Tensors as arrays: a state that was never in a file may hold tensors."""
    return value.detach().cpu().numpy() if hasattr(value, "detach") else value


def numbers(given: Any, place: str, sides: Sides) -> Any:
    """An array of finite numbers of any shape."""
    value = _on_this_machine(given)
    sound = isinstance(value, np.ndarray) and value.dtype.kind in "fiu"
    _demand(sound and bool(np.isfinite(value).all()), place, "is no array of finite numbers")
    return given


def side(name: str) -> Rule:
    """An int that equals the side of that name."""

    def rule(value: Any, place: str, sides: Sides) -> Any:
        known = sides.get(name)
        _demand(type(value) is int and known in (None, value), place, f"is not {name}, {known}")
        return value

    return rule


def maybe(schema: Schema) -> Rule:
    """None, or a value with this schema."""
    return lambda value, place, sides: None if value is None else check(value, schema, sides, place)


def each(schema: Schema, most: float = np.inf) -> Rule:
    """A list of values with this schema, so many at most."""

    def rule(value: Any, place: str, sides: Sides) -> Any:
        _demand(isinstance(value, list) and len(value) <= most, place, "is no list, or too long")
        return [check(one, schema, sides, f"{place}[{i}]") for i, one in enumerate(value)]

    return rule


def row(*schemas: Schema) -> Rule:
    """A list with one entry for each of these schemas; it becomes a tuple."""

    def rule(value: Any, place: str, sides: Sides) -> Any:
        sound = isinstance(value, list) and len(value) == len(schemas)
        _demand(sound, place, f"is no list of {len(schemas)} entries")
        pairs = enumerate(zip(value, schemas, strict=True))
        return tuple(check(one, schema, sides, f"{place}[{i}]") for i, (one, schema) in pairs)

    return rule


def table(schema: Schema) -> Rule:
    """A dict with any keys, whose values have this schema."""

    def rule(value: Any, place: str, sides: Sides) -> Any:
        _demand(isinstance(value, dict), place, "is no dict")
        return check(value, dict.fromkeys(value, schema), sides, place)

    return rule


GENERATOR: Schema = {
    "bit_generator": text,
    "state": {"state": whole(high=2**128), "inc": whole(high=2**128)},
    "has_uint32": whole(high=1),
    "uinteger": whole(high=2**32 - 1),
}
"""State of NumPy's default generator."""
