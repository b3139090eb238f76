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
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from numbers import Real
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.errors import OptionError, ProtocolError, SpaceError, did_you_mean
from fide_plugins.runtime.registry import name_of
from fide_plugins.space.kinds import Choice, Kind
from fide_plugins.types import Float64

if TYPE_CHECKING:
    from fide_plugins.space.space import Space

_LONGEST = 1000  # characters of a text
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
_ALLOWED = (
    "a condition has numbers, parameters, + - * / **, comparisons by < <= > >= == !=, and, or, "
    f"not, and the functions {', '.join(_FUNCTIONS)}"
)


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

    def check(self, sample: Mapping[str, Any]) -> None:
        """Raise SpaceError for names that are no parameters, and for what can never work.

        sample: as `params` of `violation`, with `sample_of` each kind.
        """
        self._violation(_Walk(sample, strict=True))

    def violation(self, params: Mapping[str, Any]) -> float:
        """By how much the parameters violate it; 0 where they satisfy it.

        Raises SpaceError for parameters that are missing.
        """
        violation = self._violation(_Walk(params))
        return _VIOLATED if math.isnan(violation) else violation

    def _violation(self, walk: _Walk) -> float:
        try:
            return walk.condition(_parsed(self.text))
        except _WrongError as wrong:
            raise self._error(wrong) from None
        except RecursionError:
            raise self._error("it is nested too deeply; write several") from None

    def _error(self, wrong: object) -> SpaceError:
        return SpaceError(f"constraint {self.name} = {_short(self.text)}: {wrong}")


def sample_of(kind: Kind) -> Any:
    """A value of a parameter: of a choice a number, if it can be one."""
    values = kind.values if isinstance(kind, Choice) else [kind.low]
    return next((one for one in values if _is_number(one)), values[0])


@lru_cache(maxsize=1024)
def _parsed(text: str) -> ast.expr:
    """Tree of a text; raises _WrongError for what is no expression, or too long."""
    if len(text) > _LONGEST:
        raise _WrongError(f"it has {len(text):,} characters, of {_LONGEST:,} at most")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # Python warns of some texts, such as 1or 2
            return ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError, Warning):
        raise _WrongError(f"it is no condition; write one {_EXAMPLE}") from None


@dataclass(frozen=True, slots=True)
class _Walk:
    """Through a tree, with values of the parameters; strict: what can never work is refused."""

    params: Mapping[str, Any]
    strict: bool = False

    def condition(self, node: ast.expr) -> float:
        """By how much it is violated: 0 where it holds; NaN: it has no value."""
        match node:
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                violation = self.condition(operand)
                return violation if math.isnan(violation) else _by(violation > 0)
            case ast.BoolOp(op=op, values=values):
                return _joined(op, [self.condition(one) for one in values])
            case ast.Compare(left=left, ops=ops, comparators=right):
                pairs = zip(ops, [left, *right], right, strict=False)
                return _joined(ast.And(), [self._compared(*pair) for pair in pairs])
        value = self._value(node)
        if self.strict and not isinstance(value, bool):
            what = f"{ast.unparse(node)!r} is no condition"
            raise _WrongError(f"{what}; compare something, {_EXAMPLE}")
        return _by(value) if isinstance(value, bool) else math.nan

    def _compared(self, op: ast.cmpop, a: ast.expr, b: ast.expr) -> float:
        if type(op) in _ORDER:
            numbers = self._number(a), self._number(b)
            return math.nan if any(map(math.isnan, numbers)) else _by(*_ORDER[type(op)](*numbers))
        if not isinstance(op, ast.Eq | ast.NotEq):
            raise _WrongError(f"another comparison is not allowed; {_ALLOWED}")
        one, other = self._value(a), self._value(b)
        if one != one or other != other:
            return math.nan
        if isinstance(op, ast.NotEq):
            return _by(one != other)
        both = isinstance(one, float) and isinstance(other, float)
        return _by(one == other, abs(one - other) if both else _VIOLATED)  # type: ignore[operator]

    def _value(self, node: ast.expr) -> float | str | bool:
        """A number, a text or a truth value; NaN: it has no value."""
        match node:
            case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
                return self._computed(_OPERATORS[type(op)], [operand])
            case ast.BinOp(op=op, left=left, right=right) if type(op) in _OPERATORS:
                return self._computed(_OPERATORS[type(op)], [left, right])
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
                if name not in _FUNCTIONS:
                    raise _WrongError(f"unknown function {name!r}; {_ALLOWED}")
                return self._computed(_FUNCTIONS[name], args)
        value = self._given(node)
        if _is_number(value):
            infinite = math.inf if value > 0 else -math.inf
            return float(value) if abs(value) < _MOST else infinite
        if isinstance(value, Mapping | list):
            raise _WrongError("a group has no value of its own; name a parameter in it")
        return value if isinstance(value, bool | str) else repr(value)

    def _number(self, node: ast.expr) -> float:
        value = self._value(node)
        if isinstance(value, float):
            return value
        if self.strict:
            raise _WrongError(f"{ast.unparse(node)!r} is no number; compare it by == or !=")
        return math.nan

    def _computed(self, function: Callable[..., float], nodes: list[ast.expr]) -> float:
        """Result; NaN where there is none, and of any NaN, unlike of Python's min and pow."""
        numbers = [self._number(node) for node in nodes]
        try:
            result = float(function(*numbers))
        except (ArithmeticError, ValueError):
            return math.nan
        except TypeError:
            raise _WrongError(f"this function does not take {len(nodes)} numbers") from None
        return math.nan if any(map(math.isnan, numbers)) else result

    def _given(self, node: ast.expr) -> Any:
        """What a constant or a name such as ``beads[0].x`` stands for."""
        known: Any = ()
        match node:
            case ast.Constant(value=bool() | int() | float() | str() as value):
                return value
            case ast.Name(id="pi") if "pi" not in self.params:
                return math.pi
            case ast.Name(id=key):
                known = self.params
            case ast.Attribute(value=inner, attr=key):
                known = self._given(inner)
            case ast.Subscript(value=inner, slice=ast.Constant(value=int(key))):
                group = self._given(inner)
                known = dict(enumerate(group)) if isinstance(group, list) else ()
            case _:
                raise _WrongError(f"{ast.unparse(node)!r} is not allowed; {_ALLOWED}")
        if isinstance(known, Mapping) and key in known:
            return known[key]
        names = [str(name) for name in known] if isinstance(known, Mapping) else []
        raise _WrongError(
            f"unknown parameter {ast.unparse(node)!r}; known are {', '.join(names)}"
            f"{did_you_mean(key, names)}"
        )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _by(holds: bool, margin: float = _VIOLATED) -> float:
    return 0.0 if holds else min(max(margin, _LEAST), _MOST)


def _joined(op: ast.boolop, violations: list[float]) -> float:
    """Conditions joined by `and` or `or`; what has no value counts where no other part decides."""
    if isinstance(op, ast.And):
        if any(by > 0 for by in violations):
            return sum(_VIOLATED if math.isnan(by) else by for by in violations)
        return sum(violations)
    if 0.0 in violations:
        return 0.0
    return math.nan if any(map(math.isnan, violations)) else min(violations)


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
        self._space, self.function = space, function

    def violations(self, x: Float64) -> dict[str, float]:
        """By how much x (d,) violates each constraint, by name; 0 where it holds.

        Raises OptionError (a ValueError) if the function raises, or returns no bool or numbers.
        """
        params: Any = x.copy() if self._space is None else self._space.decode(x)
        found = {} if self._space is None else self._space.violations(params)
        if self.function is not None:
            name = name_of(self.function)
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
        assert self.function is not None
        try:
            returned: Any = self.function(params)
        except ProtocolError:
            raise
        except Exception as error:
            raise OptionError(
                f"constraints({_short(params)}) raised {error!r}; let it return False there"
            ) from error
        margins = [_margin(one) for one in np.ravel(np.asarray(returned, dtype=object))]
        if None in margins or not margins:
            raise OptionError(
                f"constraints({_short(params)}) returned {_short(returned)}; let it return True "
                "where the parameters are valid, or margins, numbers <= 0 where they are"
            )
        return math.fsum(margin for margin in margins if margin is not None and margin > 0)


def _margin(value: Any) -> float | None:
    """By how much it is violated, <= 0 where it is not; None for what is no answer."""
    if isinstance(value, bool | np.bool_):
        return 0.0 if value else _VIOLATED
    if not isinstance(value, Real):
        return None
    return _VIOLATED if math.isnan(value) else min(float(value), _MOST)


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


def _short(value: object) -> str:
    return shorten(repr(value), 120)
