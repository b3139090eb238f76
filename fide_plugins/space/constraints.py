"""What is valid: conditions on parameters as a text, and a function of the user's own.

A text such as ``inner < 0.6 * outer`` may have

    numbers          1.5, 2e-3, pi;  + - * / ** and a minus sign
    parameters       outer, hub.width, beads[0].x; a choice's text in quotes: floor == "wood"
    functions        min max abs sqrt hypot exp log sin cos tan asin acos atan atan2 floor ceil
    comparisons      < <= > >= == !=, also in a chain: 0 < a < b;  joined by and, or, not

A text is parsed into a tree, of which only these nodes are allowed, and the tree is walked: nothing
is ever evaluated as code.  All numbers are floats, so none grows without bound.  What has no value,
such as sqrt(-1) or a text where a number belongs, is NaN, and so is a condition of it.  A condition
without a value is violated.
"""

from __future__ import annotations

import ast
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from numbers import Real
from textwrap import shorten
from typing import TYPE_CHECKING, Any, NamedTuple

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
_EXAMPLE = 'such as "inner < 0.6 * outer"'
_FUNCTIONS: dict[str, Callable[..., float]] = {
    **{name: getattr(math, name) for name in ("sqrt", "hypot", "exp", "log", "floor", "ceil")},
    **{name: getattr(math, name) for name in ("sin", "cos", "tan", "asin", "acos", "atan")},
    "atan2": math.atan2,
    "abs": abs,
    "min": lambda *values: min(values),  # two or more numbers, and no sequence
    "max": lambda *values: max(values),
}
_OPERATORS: dict[type, Callable[..., float]] = {
    ast.USub: lambda a: -a,
    ast.UAdd: lambda a: a,
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


class _Condition(NamedTuple):
    """By how much a condition is violated: 0 where it holds; NaN: it has no value."""

    violation: float


_Value = float | str | _Condition
_NOTHING = _Condition(math.nan)


class _Kinds(dict[str, Any]):
    """Kinds in place of values: what can never work is refused, where values are checked."""


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
        if not isinstance(self.text, str):
            raise self._error(f"it must be a text, {_EXAMPLE}")

    def check(self, kinds: Mapping[str, Any]) -> None:
        """Raise SpaceError for names that are no parameters, and for what can never work.

        kinds: as `params` of `violation`, but with a `Kind` in place of each value.
        """
        self._condition(_Kinds(kinds))

    def violation(self, params: Mapping[str, Any]) -> float:
        """By how much the parameters violate it; 0 where they satisfy it.

        Raises SpaceError for parameters that are missing.
        """
        violation = self._condition(params).violation
        return _VIOLATED if math.isnan(violation) else violation

    def _condition(self, params: Mapping[str, Any]) -> _Condition:
        try:
            return _condition(_parsed(self.text), params)
        except _WrongError as wrong:
            raise self._error(wrong) from None

    def _error(self, wrong: object) -> SpaceError:
        return SpaceError(f"constraint {self.name} = {_short(self.text)}: {wrong}")


@lru_cache(maxsize=1024)
def _parsed(text: str) -> ast.expr:
    """Tree of a text; raises _WrongError for what is no expression, or too large."""
    if len(text) > _LONGEST:
        raise _WrongError(f"it has {len(text):,} characters, of {_LONGEST:,} at most")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # Python warns of some texts, such as 1or 2
            tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError, Warning):
        raise _WrongError(f"it is no condition; write one {_EXAMPLE}") from None
    level: list[ast.AST] = [tree]
    for _ in range(_DEEPEST):
        level = [child for node in level for child in ast.iter_child_nodes(node)]
    if level:
        raise _WrongError(f"it is nested more than {_DEEPEST} levels deep; write several")
    return tree


def _value(node: ast.expr, params: Mapping[str, Any]) -> _Value:
    """Value of a node; _WrongError for what is no node of the language, or can never work."""
    match node:
        case ast.Constant() | ast.Name() | ast.Attribute() | ast.Subscript():
            return _plain(_given(node, params))
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            (violation,) = _condition(operand, params)
            return _NOTHING if math.isnan(violation) else _holds(violation > 0)
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            return _computed(_OPERATORS[type(op)], [operand], params)
        case ast.BinOp(op=op, left=left, right=right) if type(op) in _OPERATORS:
            return _computed(_OPERATORS[type(op)], [left, right], params)
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
            if name not in _FUNCTIONS:
                raise _WrongError(f"unknown function {name!r}; known are {', '.join(_FUNCTIONS)}")
            return _computed(_FUNCTIONS[name], args, params)
        case ast.BoolOp(op=op, values=values):
            return _joined(op, [_condition(one, params) for one in values])
        case ast.Compare(left=left, ops=ops, comparators=right):
            pairs = zip(ops, [left, *right], right, strict=False)
            return _joined(ast.And(), [_compared(*pair, params) for pair in pairs])
    raise _not_allowed(node)


def _not_allowed(node: ast.expr) -> _WrongError:
    return _WrongError(
        f"{ast.unparse(node)!r} is not allowed; a condition has numbers, parameters, + - * / **, "
        f"comparisons, and, or, not, and the functions {', '.join(_FUNCTIONS)}"
    )


def _given(node: ast.expr, params: Mapping[str, Any]) -> Any:
    """What a constant or a name such as ``beads[0].x`` stands for."""
    known: Any = ()
    match node:
        case ast.Constant(value=bool() | int() | float() | str() as value):
            return value
        case ast.Name(id="pi") if "pi" not in params:
            return math.pi
        case ast.Name(id=key):
            known = params
        case ast.Attribute(value=inner, attr=key):
            known = _given(inner, params)
        case ast.Subscript(value=inner, slice=ast.Constant(value=int(key))):
            group = _given(inner, params)
            known = dict(enumerate(group)) if isinstance(group, list) else ()
        case _:
            raise _not_allowed(node)
    if isinstance(known, Mapping) and key in known:
        return known[key]
    names = [str(name) for name in known] if isinstance(known, Mapping) else []
    raise _WrongError(
        f"unknown parameter {ast.unparse(node)!r}; known are {', '.join(names)}"
        f"{did_you_mean(key, names)}"
    )


def _plain(value: Any) -> _Value:
    """A number, a text or a condition, of a constant, a parameter or its kind."""
    if isinstance(value, Float | Int):
        return float(value.low)
    if isinstance(value, Choice):  # a number, if it can be one
        numbers = [one for one in value.values if _is_number(one)]
        value = (numbers or value.values)[0]
    if isinstance(value, bool):
        return _holds(value)
    if _is_number(value):
        try:
            return float(value)
        except OverflowError:
            return math.inf if value > 0 else -math.inf
    if isinstance(value, Mapping | list):
        raise _WrongError("a group has no value of its own; name a parameter in it")
    return value if isinstance(value, str) else repr(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _holds(holds: bool, margin: float = _VIOLATED) -> _Condition:
    return _Condition(0.0 if holds else min(max(margin, _LEAST), _MOST))


def _condition(node: ast.expr, params: Mapping[str, Any]) -> _Condition:
    value = _value(node, params)
    if not isinstance(value, _Condition) and isinstance(params, _Kinds):
        raise _WrongError(f"{ast.unparse(node)!r} is no condition; compare something, {_EXAMPLE}")
    return value if isinstance(value, _Condition) else _NOTHING


def _number(node: ast.expr, params: Mapping[str, Any]) -> float:
    value = _value(node, params)
    if not isinstance(value, float) and isinstance(params, _Kinds):
        raise _WrongError(f"{ast.unparse(node)!r} is no number; compare it by == or !=")
    return value if isinstance(value, float) else math.nan


def _computed(
    function: Callable[..., float], nodes: list[ast.expr], params: Mapping[str, Any]
) -> float:
    """Result; NaN where there is none, and of any NaN, unlike of Python's min and pow."""
    numbers = [_number(node, params) for node in nodes]
    try:
        result = float(function(*numbers))
    except (ArithmeticError, ValueError):
        return math.nan
    except TypeError:
        raise _WrongError(f"this function does not take {len(nodes)} numbers") from None
    return math.nan if any(map(math.isnan, numbers)) else result


def _compared(op: ast.cmpop, a: ast.expr, b: ast.expr, params: Mapping[str, Any]) -> _Condition:
    """One comparison."""
    if type(op) in _ORDER:
        numbers = _number(a, params), _number(b, params)
        return _NOTHING if any(map(math.isnan, numbers)) else _holds(*_ORDER[type(op)](*numbers))
    if not isinstance(op, ast.Eq | ast.NotEq):
        raise _WrongError("it compares by something else than < <= > >= == !=")
    if isinstance(params, _Kinds):
        _check_choice(a, b, params)
        _check_choice(b, a, params)
    one, other = _value(a, params), _value(b, params)
    equal, by = one == other, _VIOLATED
    if isinstance(one, float) and isinstance(other, float):
        by = abs(one - other)
    elif isinstance(one, _Condition) and isinstance(other, _Condition):
        equal, by = (one.violation == 0) == (other.violation == 0), one.violation + other.violation
    if math.isnan(by) or any(value != value for value in (one, other)):
        return _NOTHING
    return _holds(equal, by) if isinstance(op, ast.Eq) else _holds(not equal)


def _check_choice(node: ast.expr, constant: ast.expr, kinds: _Kinds) -> None:
    """Raise _WrongError if a parameter is compared with a text that it can never be."""
    is_text = isinstance(constant, ast.Constant) and isinstance(constant.value, str)
    if not is_text or not isinstance(node, ast.Name | ast.Attribute | ast.Subscript):
        return
    kind, text = _given(node, kinds), constant.value  # type: ignore[attr-defined]
    values = [str(one) for one in kind.values] if isinstance(kind, Choice) else ["a number"]
    if text not in values:
        raise _WrongError(
            f"{ast.unparse(node)!r} is never {text!r}; it can be "
            f"{shorten(', '.join(values), 200)}{did_you_mean(text, values)}"
        )


def _joined(op: ast.boolop, parts: list[_Condition]) -> _Condition:
    """Conditions joined by `and` or `or`; what has no value counts where no other part decides."""
    violations = [part.violation for part in parts]
    if isinstance(op, ast.And):
        if any(by > 0 for by in violations):
            return _Condition(sum(_VIOLATED if math.isnan(by) else by for by in violations))
        return _Condition(sum(violations))
    if 0.0 in violations:
        return _Condition(0.0)
    return _NOTHING if any(map(math.isnan, violations)) else _Condition(min(violations))


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
        several = returned if isinstance(returned, list | tuple | np.ndarray) else [returned]
        margins = list(_margins(several))
        if None in margins or not margins:
            raise OptionError(
                f"constraints({_short(params)}) returned {_short(returned)}; let it return True "
                "where the parameters are valid, or margins, numbers <= 0 where they are"
            )
        return math.fsum(margin for margin in margins if margin is not None and margin > 0)


def constraints_of(space: Space | None, function: object) -> Constraints | None:
    """Constraints of a run; None if there are none.  Raises OptionError for what is no function."""
    if function is not None and not callable(function):
        raise OptionError(
            "constraints must be a function of the parameters that returns True where they are "
            f"valid, or margins (<= 0 where they are), not {_short(function)}; texts are of the "
            "space: Space(..., constraints={'wall': 'inner < outer'})"
        )
    if function is None and (space is None or not space.constraints):
        return None
    return Constraints(space, function)


def _margins(values: Any) -> Iterator[float | None]:
    """By how much each is violated, <= 0 where it is not; None for what is no answer."""
    for value in values.ravel() if isinstance(values, np.ndarray) else values:
        if isinstance(value, bool | np.bool_):
            yield 0.0 if value else _VIOLATED
        elif isinstance(value, Real):
            yield _VIOLATED if math.isnan(value) else min(float(value), _MOST)
        else:
            yield None


def _short(value: object) -> str:
    return shorten(repr(value), 120)
