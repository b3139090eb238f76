"""Conditions on parameters as a text, such as ``inner < 0.6 * outer``.

    numbers          1.5, 2e-3, pi;  + - * / ** and a minus sign
    parameters       outer, hub.width, beads[0].x; a choice's text in quotes: floor == "wood"
    functions        min max abs sqrt hypot exp log sin cos tan asin acos atan atan2 floor ceil
    comparisons      < <= > >= == !=, also in a chain: 0 < a < b;  joined by and, or, not

A text is parsed into a tree, of which only these nodes are allowed, and the tree is walked: nothing
is ever evaluated as code.  All numbers are floats, so none grows without bound.
"""

from __future__ import annotations

import ast
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeAlias

from fide_plugins.errors import SpaceError, did_you_mean

__all__ = ["Expression"]

_LONGEST, _DEEPEST = 1000, 50  # characters of a text, and levels of its tree
_VIOLATED = 1.0  # by how much, where there is no number
_LEAST = 1e-12  # such as of a < b where they are equal
_UNARY = {ast.USub: lambda a: -a, ast.UAdd: lambda a: a}
_BINARY: dict[type, Callable[[float, float], float]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
    ast.Pow: math.pow,
}
_ORDER: dict[type, Callable[[float, float], tuple[bool, float]]] = {
    ast.Lt: lambda a, b: (a < b, a - b),
    ast.LtE: lambda a, b: (a <= b, a - b),
    ast.Gt: lambda a, b: (a > b, b - a),
    ast.GtE: lambda a, b: (a >= b, b - a),
}
_FUNCTIONS: dict[str, Callable[..., float]] = {
    **{name: getattr(math, name) for name in ("sqrt", "hypot", "exp", "log", "floor", "ceil")},
    **{name: getattr(math, name) for name in ("sin", "cos", "tan", "asin", "acos", "atan")},
    "atan2": math.atan2,
    "abs": abs,
    "min": lambda *values: min(values),  # two or more numbers, and no sequence
    "max": lambda *values: max(values),
}


@dataclass(frozen=True, slots=True)
class _Truth:
    """Whether a condition holds, and by how much it is violated: > 0 where it does not."""

    holds: bool
    violation: float

    @classmethod
    def of(cls, holds: bool, margin: float = _VIOLATED) -> _Truth:
        if holds:
            return cls(True, 0.0)
        return cls(False, max(margin, _LEAST) if math.isfinite(margin) else _VIOLATED)


_Value: TypeAlias = "float | str | _Truth"


class _WrongError(Exception):
    """What is wrong with an expression."""


@dataclass(frozen=True, slots=True)
class Expression:
    """A condition that parameters must satisfy.

    name: of the constraint; text: as it was written.

    Raises SpaceError (a ValueError), naming both and the rule, for what is no such condition.
    """

    name: str
    text: str

    def __post_init__(self) -> None:
        try:
            _parsed(self.text)
        except _WrongError as wrong:
            raise self._error(wrong) from None

    def check(self, params: Mapping[str, Any]) -> None:
        """Raise SpaceError for names that are no parameters, and texts where numbers belong."""
        try:
            self._truth(params)
        except _WrongError as wrong:
            raise self._error(wrong) from None

    def violation(self, params: Mapping[str, Any]) -> float:
        """By how much the parameters violate it; 0 where they satisfy it.

        What has no value, such as 1 / 0 or sqrt(-1), is violated.
        """
        return self._truth(params).violation

    def _truth(self, params: Mapping[str, Any]) -> _Truth:
        return _condition(_value(_parsed(self.text), params))

    def _error(self, wrong: _WrongError) -> SpaceError:
        text = self.text if len(str(self.text)) <= 80 else f"{self.text[:77]}..."
        return SpaceError(f"constraint {self.name} = {text!r}: {wrong}")


# -- the tree --------------------------------------------------------------------------------------


@lru_cache(maxsize=1024)
def _parsed(text: object) -> ast.expr:
    """Tree of a text; raises _WrongError for what is no expression, or too large."""
    if not isinstance(text, str):
        raise _WrongError('it must be a text, such as "inner < 0.6 * outer"')
    if len(text) > _LONGEST:
        raise _WrongError(
            f"it has {len(text):,} characters, of {_LONGEST:,} at most; write several"
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # Python warns of some texts, such as 1or 2
            tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError, Warning):
        raise _WrongError('it is no condition; write one such as "inner < 0.6 * outer"') from None
    _check_depth(tree, _DEEPEST)
    return tree


def _check_depth(node: ast.AST, left: int) -> None:
    if left == 0:
        raise _WrongError(
            f"it is nested more than {_DEEPEST} levels deep; write several conditions"
        )
    for child in ast.iter_child_nodes(node):
        _check_depth(child, left - 1)


def _value(node: ast.expr, params: Mapping[str, Any]) -> _Value:
    """Value of a node; what is no node of the language raises _WrongError."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.Constant(value=bool() | int() | float() as number):
            return _plain(number)
        case ast.Name() | ast.Attribute() | ast.Subscript():
            return _plain(_parameter(node, params))
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return _Truth.of(not _condition(_value(operand, params)).holds)
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _UNARY:
            return _computed(_UNARY[type(op)], _numbers([operand], params))
        case ast.BinOp(op=op, left=left, right=right) if type(op) in _BINARY:
            return _computed(_BINARY[type(op)], _numbers([left, right], params))
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
            return _called(name, _numbers(args, params))
        case ast.BoolOp(op=op, values=values):
            return _joined(op, [_condition(_value(one, params)) for one in values])
        case ast.Compare(left=left, ops=ops, comparators=right):
            sides = [_value(one, params) for one in (left, *right)]
            pairs = zip(ops, sides, sides[1:], strict=False)
            return _joined(ast.And(), [_compared(*pair) for pair in pairs])
    raise _WrongError(
        f"{ast.unparse(node)!r} is not allowed; a condition has numbers, parameters, + - * / **, "
        f"comparisons, and, or, not, and the functions {', '.join(_FUNCTIONS)}"
    )


def _plain(value: Any) -> _Value:
    """A number, a text or a truth, of a constant or a parameter."""
    if isinstance(value, bool):
        return _Truth.of(value)
    if isinstance(value, int | float):
        try:
            return float(value)
        except OverflowError:
            return math.inf if value > 0 else -math.inf
    if isinstance(value, Mapping | list):
        raise _WrongError("a group has no value of its own; name a parameter in it")
    return value if isinstance(value, str) else repr(value)


def _parameter(node: ast.expr, params: Mapping[str, Any]) -> Any:
    """What a name such as ``beads[0].x`` stands for."""
    name = ast.unparse(node)
    match node:
        case ast.Name(id=key):
            if key in params:
                return params[key]
            if key == "pi":
                return math.pi
            known = params
        case ast.Attribute(value=inner, attr=key):
            group = _parameter(inner, params)
            if isinstance(group, Mapping) and key in group:
                return group[key]
            known = group if isinstance(group, Mapping) else {}
        case ast.Subscript(value=inner, slice=ast.Constant(value=int(key))):
            group = _parameter(inner, params)
            if isinstance(group, list) and not isinstance(key, bool) and 0 <= key < len(group):
                return group[key]
            known = {}
        case _:
            raise _WrongError(f"{name!r} is no parameter; write its name, such as beads[0].x")
    listed = f"; known are {', '.join(known)}{did_you_mean(key, known)}" if known else ""
    raise _WrongError(f"unknown parameter {name!r}{listed}")


def _numbers(nodes: list[ast.expr], params: Mapping[str, Any]) -> list[float]:
    """Values that must be numbers."""
    values = [_value(node, params) for node in nodes]
    for node, value in zip(nodes, values, strict=True):
        if not isinstance(value, float):
            raise _WrongError(f"{ast.unparse(node)!r} is no number, and one can only compare it")
    return values  # type: ignore[return-value]


def _computed(function: Callable[..., float], values: list[float]) -> float:
    """Result; NaN where there is none, which no comparison accepts."""
    try:
        return float(function(*values))
    except (ArithmeticError, ValueError):
        return math.nan


def _called(name: str, values: list[float]) -> float:
    if name not in _FUNCTIONS:
        known = ", ".join(_FUNCTIONS)
        raise _WrongError(f"unknown function {name!r}; known are {known}")
    try:
        return _computed(_FUNCTIONS[name], values)
    except TypeError:
        raise _WrongError(f"{name} does not take {len(values)} numbers") from None


def _compared(op: ast.cmpop, a: _Value, b: _Value) -> _Truth:
    """One comparison."""
    if isinstance(op, ast.Eq | ast.NotEq):
        difference = abs(a - b) if isinstance(a, float) and isinstance(b, float) else math.nan
        equal = difference == 0 if isinstance(a, float) and isinstance(b, float) else a == b
        return _Truth.of(equal, difference) if isinstance(op, ast.Eq) else _Truth.of(not equal)
    if type(op) not in _ORDER:
        raise _WrongError("it compares by something else than < <= > >= == !=")
    if not (isinstance(a, float) and isinstance(b, float)):
        raise _WrongError("only numbers have an order; compare a text by == or !=")
    return _Truth.of(*_ORDER[type(op)](a, b))


def _joined(op: ast.boolop, parts: list[_Truth]) -> _Truth:
    """Conditions joined by `and` or `or`."""
    if isinstance(op, ast.Or):
        return min(parts, key=lambda part: part.violation)
    return _Truth(all(part.holds for part in parts), sum(part.violation for part in parts))


def _condition(value: _Value) -> _Truth:
    if not isinstance(value, _Truth):
        raise _WrongError("it is no condition; compare something, such as inner < 0.6 * outer")
    return value
