"""What is valid: conditions on parameters as a text, and a function of the user's own.

A text such as ``inner < 0.6 * outer`` may have

    numbers          1.5, 2e-3, pi;  + - * / ** and a minus sign
    parameters       outer, hub.width, beads[0].x; a choice's text in quotes: floor == "wood"
    functions        min max abs sqrt hypot exp log sin cos tan asin acos atan atan2 floor ceil
    comparisons      < <= > >= == !=, also in a chain: 0 < a < b;  joined by and, or, not

A text is parsed into a tree, of which only these nodes are allowed, and the tree is walked: nothing
is ever evaluated as code.  All numbers are floats, so none grows without bound.

A truth is True, False or None.  None is that of a comparison without a value, as of sqrt(-1), and
of the order of a text and a number, as of a choice of both.  It is as in logic with three values:
``not None`` is None, ``None or True`` is True, ``None and False`` is False.  A condition holds
where it is True.
"""

from __future__ import annotations

import ast
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from numbers import Real
from textwrap import shorten
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from fide_plugins.errors import OptionError, ProtocolError, SpaceError, did_you_mean
from fide_plugins.runtime.registry import name_of
from fide_plugins.space.kinds import Choice, Float, Int
from fide_plugins.types import Float64

if TYPE_CHECKING:
    from fide_plugins.space.space import Space

__all__ = ["Constraints", "Expression", "constraints_not_stored", "constraints_of"]

_LONGEST, _DEEPEST = 1000, 50  # characters of a text, and levels of its tree
_VIOLATED = 1.0  # by how much, where there is no number
_LEAST = 1e-12  # such as of a < b where they are equal
_MOST = 1e100  # so that sums are finite
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
    """Whether a condition holds, None without a value, and by how much it is violated, >= 0."""

    holds: bool | None
    violation: float

    @classmethod
    def of(cls, holds: bool | None, margin: float = _VIOLATED) -> _Truth:
        if holds:
            return cls(True, 0.0)
        return cls(holds, _VIOLATED if math.isnan(margin) else min(max(margin, _LEAST), _MOST))


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
            if not isinstance(self.text, str):
                raise _WrongError('it must be a text, such as "inner < 0.6 * outer"')
            _parsed(self.text)
        except _WrongError as wrong:
            raise self._error(wrong) from None

    def check(self, params: Mapping[str, Any]) -> None:
        """Raise SpaceError for names that are no parameters, and for what can never work.

        params: as of `violation`, but with a `Kind` in place of each value.  A choice may be where
            numbers belong if some of its values are numbers.
        """
        try:
            _check_is(_Truth, _parsed(self.text), params)
        except _WrongError as wrong:
            raise self._error(wrong) from None

    def violation(self, params: Mapping[str, Any]) -> float:
        """By how much the parameters violate it; 0 where they satisfy it.

        What has no value, such as 1 / 0 or sqrt(-1), is violated.  Raises SpaceError for parameters
        that are missing.
        """
        try:
            return _condition(_value(_parsed(self.text), params)).violation
        except _WrongError as wrong:
            raise self._error(wrong) from None

    def _error(self, wrong: _WrongError) -> SpaceError:
        text = self.text if len(str(self.text)) <= 80 else f"{self.text[:77]}..."
        return SpaceError(f"constraint {self.name} = {text!r}: {wrong}")


# -- the tree --------------------------------------------------------------------------------------


@lru_cache(maxsize=1024)
def _parsed(text: str) -> ast.expr:
    """Tree of a text; raises _WrongError for what is no expression, or too large."""
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
    """Value of a node that was checked; what is no node of the language raises _WrongError."""
    match node:
        case ast.Constant() | ast.Name() | ast.Attribute() | ast.Subscript():
            return _plain(_given(node, params))
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            holds = _condition(_value(operand, params)).holds
            return _Truth.of(None if holds is None else not holds)
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
    raise _not_allowed(node)


def _not_allowed(node: ast.expr) -> _WrongError:
    return _WrongError(
        f"{ast.unparse(node)!r} is not allowed; a condition has numbers, parameters, + - * / **, "
        f"comparisons, and, or, not, and the functions {', '.join(_FUNCTIONS)}"
    )


def _given(node: ast.expr, params: Mapping[str, Any]) -> Any:
    """What a constant or a name stands for."""
    if not isinstance(node, ast.Constant):
        return _parameter(node, params)
    if not isinstance(node.value, bool | int | float | str):
        raise _not_allowed(node)
    return node.value


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
    """Values that must be numbers; NaN for others, as of a choice of numbers and texts."""
    values = [_value(node, params) for node in nodes]
    return [value if isinstance(value, float) else math.nan for value in values]


def _computed(function: Callable[..., float], values: list[float]) -> float:
    """Result; NaN where there is none: so it is of any NaN, unlike of Python's min and pow."""
    if any(map(math.isnan, values)):
        return math.nan
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
    if _has_no_value(a) or _has_no_value(b):
        return _Truth.of(None)
    if isinstance(op, ast.Eq | ast.NotEq):
        equal, by = a == b, _VIOLATED
        if isinstance(a, float) and isinstance(b, float):
            by = abs(a - b)
        elif isinstance(a, _Truth) and isinstance(b, _Truth):
            equal = a.holds == b.holds
        return _Truth.of(equal, by) if isinstance(op, ast.Eq) else _Truth.of(not equal)
    if isinstance(a, float) and isinstance(b, float):
        return _Truth.of(*_ORDER[type(op)](a, b))
    return _Truth.of(None)


def _has_no_value(value: _Value) -> bool:
    if isinstance(value, float):
        return math.isnan(value)
    return isinstance(value, _Truth) and value.holds is None


def _joined(op: ast.boolop, parts: list[_Truth]) -> _Truth:
    """Conditions joined by `and` or `or`."""
    is_or = isinstance(op, ast.Or)
    truths = {part.holds for part in parts}
    holds = is_or if is_or in truths else None if None in truths else not is_or
    violations = [part.violation for part in parts]
    return _Truth(holds, min(violations) if is_or else sum(violations))


def _condition(value: _Value) -> _Truth:
    return value if isinstance(value, _Truth) else _Truth.of(None)


# -- what can never work ---------------------------------------------------------------------------


def _types(node: ast.expr, params: Mapping[str, Any]) -> set[type]:
    """Types that a node's value can have; raises _WrongError for what can never work."""
    match node:
        case ast.Constant() | ast.Name() | ast.Attribute() | ast.Subscript():
            values = _possible(node, params)
            return {float} if values is None else {type(value) for value in values}
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            _check_is(_Truth, operand, params)
            return {_Truth}
        case ast.BoolOp(values=parts):
            for one in parts:
                _check_is(_Truth, one, params)
            return {_Truth}
        case ast.Compare(left=left, ops=ops, comparators=right):
            for op, a, b in zip(ops, [left, *right], right, strict=False):
                _check_comparison(op, a, b, params)
            return {_Truth}
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _UNARY:
            parts = [operand]
        case ast.BinOp(op=op, left=left, right=one) if type(op) in _BINARY:
            parts = [left, one]
        case ast.Call(func=ast.Name(id=name), args=parts, keywords=[]):
            _called(name, [0.5] * len(parts))
        case _:
            raise _not_allowed(node)
    for one in parts:
        _check_is(float, one, params)
    return {float}


def _check_is(needed: type, node: ast.expr, params: Mapping[str, Any]) -> None:
    """Raise _WrongError if a node can have no value of this type, a number or a truth."""
    if needed in _types(node, params):
        return
    if needed is float:
        raise _WrongError(f"{ast.unparse(node)!r} is no number, and one can only compare it")
    raise _WrongError("it is no condition; compare something, such as inner < 0.6 * outer")


def _check_comparison(op: ast.cmpop, a: ast.expr, b: ast.expr, params: Mapping[str, Any]) -> None:
    """Raise _WrongError if the two sides can never be compared, or never be equal."""
    left, right = _types(a, params), _types(b, params)
    if not isinstance(op, ast.Eq | ast.NotEq):
        if type(op) not in _ORDER:
            raise _WrongError("it compares by something else than < <= > >= == !=")
        if not (float in left and float in right):
            raise _WrongError("only numbers have an order; compare a text by == or !=")
        return
    if not left & right:
        raise _WrongError(f"{ast.unparse(a)!r} and {ast.unparse(b)!r} are never equal")
    for one, other in ((a, b), (b, a)):
        if isinstance(one, ast.Constant):
            _check_has(other, one, params)


def _check_has(node: ast.expr, constant: ast.Constant, params: Mapping[str, Any]) -> None:
    """Raise _WrongError if a node is a choice without this constant as a value."""
    if not isinstance(node, ast.Name | ast.Attribute | ast.Subscript):
        return
    values = _possible(node, params)
    if values is None or _plain(constant.value) in values:
        return
    texts = [str(v.holds if isinstance(v, _Truth) else v) for v in values]
    raise _WrongError(
        f"{ast.unparse(node)!r} is never {constant.value!r}; it can be "
        f"{shorten(', '.join(texts), 200)}{did_you_mean(constant.value, texts)}"
    )


def _possible(node: ast.expr, params: Mapping[str, Any]) -> list[_Value] | None:
    """Every value of a constant or a parameter, a kind; None: any number."""
    given = _given(node, params)
    if isinstance(given, Float | Int):
        return None
    return [_plain(one) for one in (given.values if isinstance(given, Choice) else [given])]


# -- constraints of a run --------------------------------------------------------------------------


def constraints_not_stored(params: object) -> bool:
    """In place of a user's function, which a checkpoint cannot hold; raises ProtocolError."""
    raise ProtocolError(
        "this optimizer was saved with a function of constraints, which a checkpoint cannot hold; "
        "to ask for more, give it again: load(path, constraints=function)"
    )


class Constraints:
    """By how much points of the cube violate constraints.

    space: the parameters, and their conditions; None: the function gets x (d,).
    function: as `constraints` of `FIDE`; None: only the conditions of the space.
    """

    def __init__(self, space: Space | None, function: Callable[[Any], object] | None) -> None:
        self._space, self._function = space, function

    def violations(self, x: Float64) -> dict[str, float]:
        """By how much x (d,) violates each constraint, by name; 0 where it holds.

        Raises OptionError (a ValueError) if the function raises, or returns no bool or numbers.
        """
        params: Any = x.copy() if self._space is None else self._space.decode(x)
        found = {} if self._space is None else self._space.violations(params)
        if self._function is not None:
            name = name_of(self._function)
            found["constraints" if name == "<lambda>" else name] = self._own(params)
        return found

    def __call__(self, X: Float64) -> Float64:
        """Sum of the violations of each point X (n, d): (n,), 0 for valid ones."""
        return np.array([math.fsum(self.violations(x).values()) for x in X])

    def explain(self, x: Float64) -> str:
        """Which constraints x (d,) violates, in words."""
        texts = {} if self._space is None else self._space.constraints
        violated = [name for name, by in self.violations(x).items() if by > 0]
        return ", ".join(f"{n} ({texts[n]})" if n in texts else n for n in violated)

    def _own(self, params: Any) -> float:
        assert self._function is not None
        try:
            returned: Any = self._function(params)
        except ProtocolError:
            raise
        except Exception as error:
            raise OptionError(
                f"constraints({_short(params)}) raised {error!r}; let it return False there"
            ) from error
        several = returned.ravel() if isinstance(returned, np.ndarray) else returned
        if not isinstance(several, list | tuple | np.ndarray):
            several = [several]
        margins = [_margin(one) for one in several]
        if None in margins or not margins:
            raise OptionError(
                f"constraints({_short(params)}) returned {_short(returned)}; let it return True "
                "where the parameters are valid, or margins, numbers <= 0 where they are"
            )
        return math.fsum(margin for margin in margins if margin is not None and margin > 0)


def constraints_of(space: Space | None, function: object) -> Constraints | None:
    """Constraints of a run; None if there are none.  Raises OptionError for what is no function."""
    if function is not None and not callable(function):
        hint = ""
        if isinstance(function, Mapping | str):
            hint = "; texts are of the space: Space(..., constraints={'wall': 'inner < outer'})"
        raise OptionError(
            "constraints must be a function of the parameters that returns True where they are "
            f"valid, or margins (<= 0 where they are), not {_short(function)}{hint}"
        )
    if function is None and (space is None or not space.constraints):
        return None
    return Constraints(space, function)


def _margin(value: object) -> float | None:
    """By how much one constraint is violated, <= 0 where it is not; None for what is no answer."""
    if isinstance(value, bool | np.bool_):
        return 0.0 if value else _VIOLATED
    if not isinstance(value, Real):
        return None
    margin = float(value)
    return _VIOLATED if math.isnan(margin) else min(margin, 1e100)


def _short(value: object) -> str:
    return shorten(repr(value), 120)
