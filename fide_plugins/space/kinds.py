"""What one parameter is: a number, a whole number, or one of several values.

Every kind maps its values to numbers, and `layout` maps numbers to the cube:

=======================  ======  ==================================================================
kind                     axes    number of a value, and its place in the cube
=======================  ======  ==================================================================
Float                    1       the value; linear, or its logarithm
Int, Float with a step   1       the value; n values are n equal cells of the axis (with log: equal
                                 in the value, of an axis from log(low - 1/2) to log(high + 1/2))
Choice of n >= 3         n       index of the value; the axis with the largest coordinate decides
Choice of 2              1       0 or 1; two equal cells
Choice of 1              0       a constant
=======================  ======  ==================================================================

A choice has one axis a value because its values have no order: on one axis the first value would
be a neighbor of the second and far from the third, and a search could reach the third only through
the second.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field
from functools import wraps
from inspect import Parameter, signature
from typing import Any, ClassVar, NamedTuple, TypeAlias, TypeVar

from fide_plugins.errors import SpaceError, did_you_mean
from fide_plugins.validation.points import as_real, as_whole, whole_instead

__all__ = ["Choice", "Float", "Int", "Kind", "Scale", "is_synonym", "right_word"]

T = TypeVar("T")

_MOST_CELLS = 2**40  # of an axis; beyond, doubles do not tell the cells of a logarithmic axis apart
_LARGEST_INT = 2**53  # doubles hold every whole number up to it
_LARGEST_LOG = 2**44  # beyond, doubles do not tell the logarithms of neighbors well apart
_MOST_CHOICES = 1000
_OFF_GRID = 1e-6  # of a step, by which a value may miss the grid
_LEAST_STEP = 16  # units in the last place of the largest value
_SYNONYMS = {
    "low": ("min", "minimum", "lower", "lower_bound", "lo", "start", "from"),
    "high": ("max", "maximum", "upper", "upper_bound", "hi", "stop", "end", "to"),
    "unit": ("units",),
    "log": ("logarithmic", "log_scale", "logscale", "logspace"),
    "periodic": ("wrap", "wraps", "wrapped", "cyclic", "circular", "angle"),
    "step": ("steps", "stride", "increment", "spacing", "q"),
    "values": ("value", "choices", "options", "categories", "items"),
}
_OF = {synonym: word for word, synonyms in _SYNONYMS.items() for synonym in synonyms}


# -- arguments -------------------------------------------------------------------------------------


def is_synonym(name: str) -> bool:
    """Whether other libraries and users have this word for something that a parameter has."""
    return name.lower() in _OF


def right_word(name: object, known: Iterable[str]) -> str:
    """End of a message about a name that is not known: the word that is meant, if that is clear.

    >>> right_word("units", ["low", "unit"]), right_word("hihg", ["high"]), right_word("x", ["low"])
    ("; did you mean 'unit'?", "; did you mean 'high'?", '')
    """
    words = list(known)
    word = _OF.get(str(name).lower())
    return f"; did you mean {word!r}?" if word in words else did_you_mean(name, words)


def _explained(usage: str) -> Callable[[type[T]], type[T]]:
    """Decorator of a class whose constructor says which argument is wrong, and what is right."""

    def decorate(cls: type[T]) -> type[T]:
        init: Any = vars(cls)["__init__"]
        of_class = signature(init)

        @wraps(init)
        def checked(self: T, *args: Any, **kwargs: Any) -> None:
            try:
                of_class.bind(self, *args, **kwargs)
            except TypeError:
                _explain(cls.__name__, list(of_class.parameters.values())[1:], args, kwargs, usage)
                raise
            init(self, *args, **kwargs)

        setattr(cls, "__init__", checked)  # noqa: B010  # of a class that may be anything
        return cls

    return decorate


def _explain(
    kind: str, parameters: list[Parameter], args: Any, kwargs: dict[str, Any], usage: str
) -> None:
    """Raise SpaceError for arguments that do not fit the parameters."""
    names = [p.name for p in parameters if p.kind is not Parameter.VAR_POSITIONAL]
    positional = [p.name for p in parameters if p.kind is Parameter.POSITIONAL_OR_KEYWORD]
    for name in kwargs:
        if name not in names:
            takes = f"it takes {', '.join(names)}" if names else f"write {usage}"
            raise SpaceError(f"{kind} has no argument {name!r}; {takes}{right_word(name, names)}")
    if len(args) > len(positional):
        raise SpaceError(
            f"{kind} takes {' and '.join(positional)} by position and all else by name, not "
            f"{len(args)} values; write {usage}"
        )
    for name in positional[: len(args)]:
        if name in kwargs:
            raise SpaceError(f"{kind} has {name} by position and by name; write {usage}")
    for name in positional[len(args) :]:
        if name not in kwargs:
            raise SpaceError(f"{kind} needs {name}; write {usage}")


# -- kinds -----------------------------------------------------------------------------------------


class Scale(NamedTuple):
    """Numbers from low to high; with a step > 0 only low, low + step, ... up to high."""

    low: float
    high: float
    step: float
    log: bool


class _Number:
    """What `Float` and `Int` share: one axis, from low to high."""

    low: Any
    high: Any
    step: Any
    log: bool

    def __repr__(self) -> str:
        return _show(self, "low", "high")

    @property
    def width(self) -> int:
        """Number of axes."""
        return 1

    @property
    def scale(self) -> Scale:
        """Its numbers."""
        return Scale(self.low, self.high, self.step or 0.0, self.log)


@_explained("Float(0, 1)")
@dataclass(frozen=True, repr=False)
class Float(_Number):
    """A real number in [low, high].

    low, high: finite, low < high.
    unit: for people, such as "deg" or "m".
    log: whether its logarithm is searched; low must be above 0.
    periodic: whether high is the same as low, as for an angle; the search wraps around.
    step: only low, low + step, ... are meant; high becomes the last of them.  It must be at least
        16 times as wide as doubles are apart there.  None: every number.

    Raises SpaceError (a ValueError).
    """

    type: ClassVar[str] = "float"
    low: float
    high: float
    unit: str | None = field(default=None, kw_only=True)
    log: bool = field(default=False, kw_only=True)
    periodic: bool = field(default=False, kw_only=True)
    step: float | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        low, high = (_real(self, name, getattr(self, name)) for name in ("low", "high"))
        _check_range(self, low, high)
        _check_settings(self)
        if self.log and low <= 0:
            _refuse(self, f"the logarithm needs low > 0, not {low}", "raise low, or drop log")
        if self.step is not None:
            step = _real(self, "step", self.step)
            high = _last_on_grid(self, low, high, step)
            object.__setattr__(self, "step", step)
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    def value(self, number: float) -> float:
        """Value of a number of the scale."""
        return float(number)

    def number(self, name: str, value: Any) -> float:
        """Number of a value; SpaceError, with the parameter's `name`, if it is none of its own."""
        number = as_real(value)
        if number is None or not self.low <= number <= self.high:
            raise SpaceError(_outside(name, self, f"a number in [{self.low}, {self.high}]", value))
        if self.step is not None:
            steps = (number - self.low) / self.step
            if abs(steps - round(steps)) > _off_grid(self.low, self.high, self.step):
                rule = f"one of {self.low}, {self.low + self.step}, ... {self.high}"
                raise SpaceError(_outside(name, self, rule, value))
        return number


@_explained("Int(1, 8)")
@dataclass(frozen=True, repr=False)
class Int(_Number):
    """A whole number in [low, high], both included.

    low, high: whole, at most 2^53 from zero, low < high, at most 2^40 values.
    unit: for people.
    log: whether its logarithm is searched; low must be above 0, high at most 2^44.
    step: only low, low + step, ... are meant; high becomes the last of them.

    Raises SpaceError (a ValueError).
    """

    type: ClassVar[str] = "int"
    low: int
    high: int
    unit: str | None = field(default=None, kw_only=True)
    log: bool = field(default=False, kw_only=True)
    step: int = field(default=1, kw_only=True)

    def __post_init__(self) -> None:
        low, high, step = (_whole(self, n, getattr(self, n)) for n in ("low", "high", "step"))
        _check_range(self, low, high)
        _check_settings(self)
        if self.log and low <= 0:
            _refuse(self, f"the logarithm needs low >= 1, not {low}", "raise low, or drop log")
        if self.log and step != 1:
            _refuse(self, f"log needs step 1, not {step}", "drop one of them")
        high = int(_last_on_grid(self, low, high, step))
        if self.log and high > _LARGEST_LOG:
            rule = f"the logarithm needs high <= 2^44, not {high}"
            _refuse(self, f"{rule}: doubles do not tell neighbors apart", "lower high, or drop log")
        for name, value in (("low", low), ("high", high), ("step", step)):
            object.__setattr__(self, name, value)

    def value(self, number: float) -> int:
        """Value of a number of the scale."""
        return int(number)

    def number(self, name: str, value: Any) -> float:
        """Number of a value; SpaceError, with the parameter's `name`, if it is none of its own."""
        number = as_real(value)
        if number is None or not self.low <= number <= self.high or number != round(number):
            rule = f"a whole number in [{self.low}, {self.high}]"
            raise SpaceError(_outside(name, self, rule, value))
        if (round(number) - self.low) % self.step:
            rule = f"one of {self.low}, {self.low + self.step}, ... {self.high}"
            raise SpaceError(_outside(name, self, rule, value))
        return number


@_explained("Choice('a', 'b')")
@dataclass(frozen=True, init=False, repr=False, eq=False)
class Choice:
    """One of some values without an order: texts, numbers, anything hashable.

    values: one or more, at most 1,000, all different; of one value it is a constant.

    Raises SpaceError (a ValueError).
    """

    type: ClassVar[str] = "choice"
    unit: ClassVar[str | None] = None
    values: tuple[Any, ...]

    def __init__(self, *values: Hashable) -> None:
        object.__setattr__(self, "values", values)
        if not 0 < len(values) <= _MOST_CHOICES:
            rule = f"needs 1 to {_MOST_CHOICES} values, not {len(values)}"
            raise SpaceError(f"Choice {rule}; write them one by one: Choice('a', 'b')")
        if len(values) == 1 and isinstance(values[0], list | tuple | set | frozenset | dict):
            raise SpaceError(f"Choice takes its values one by one: Choice(*{values[0]!r})")
        index: dict[Any, int] = {}
        for value in values:
            _check_choice(value, index)
            index[value] = len(index)
        object.__setattr__(self, "_index", index)

    def __repr__(self) -> str:
        return f"Choice({', '.join(map(repr, self.values))})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Choice) and self._typed() == other._typed()

    def __hash__(self) -> int:
        return hash(self._typed())

    def _typed(self) -> tuple[Any, ...]:
        """Values that tell 1 from True."""
        return tuple((type(value), value) for value in self.values)

    @property
    def width(self) -> int:
        """Number of axes."""
        return len(self.values) if len(self.values) > 2 else len(self.values) - 1

    @property
    def scale(self) -> Scale:
        """Its numbers: indices of the values."""
        return Scale(0.0, len(self.values) - 1.0, 1.0, False)

    def value(self, number: float) -> Any:
        """Value of a number, its index."""
        return self.values[int(number)]

    def number(self, name: str, value: Any) -> float:
        """Index of a value; SpaceError, with the parameter's `name`, if it is none of its own."""
        index: dict[Any, int] = self.__dict__["_index"]
        try:
            found = index.get(value)
        except TypeError:  # not hashable
            found = None
        if found is None:
            rule = f"one of {', '.join(map(repr, self.values))}"
            raise SpaceError(_outside(name, self, rule, value))
        return float(found)


Kind: TypeAlias = Float | Int | Choice


# -- checks ----------------------------------------------------------------------------------------


def _show(kind: Any, *positional: str) -> str:
    """Return the expression that makes it, without what is as by default."""
    words = [repr(getattr(kind, name)) for name in positional]
    for name, parameter in kind.__dataclass_fields__.items():
        if name not in positional and getattr(kind, name) != parameter.default:
            words.append(f"{name}={getattr(kind, name)!r}")
    return f"{type(kind).__name__}({', '.join(words)})"


def _refuse(kind: Any, rule: str, remedy: str) -> None:
    raise SpaceError(f"{_show(kind, 'low', 'high')}: {rule}; {remedy}")


def _outside(name: str, kind: Kind, rule: str, value: Any) -> str:
    hint = f"; change the value, or the parameter {kind!r}"
    return f"parameter {name!r} must be {rule}, not {value!r}{hint}"


def _real(kind: Any, name: str, value: Any) -> float:
    number = as_real(value)
    if number is None or not math.isfinite(number):
        _refuse(kind, f"{name} must be a finite number, not {value!r}", f"give {name} as a number")
    assert number is not None
    return number


def _whole(kind: Any, name: str, value: Any) -> int:
    number = as_whole(value)
    if number is None or abs(number) > _LARGEST_INT:
        instead = whole_instead(value)
        small = instead is not None and abs(instead) <= _LARGEST_INT
        remedy = f"write {instead}" if small else "use Float for real numbers"
        _refuse(kind, f"{name} must be a whole number of at most 2^53, not {value!r}", remedy)
    assert number is not None
    return number


def _check_range(kind: Any, low: float, high: float) -> None:
    if not low < high:
        _refuse(kind, "low must be less than high", "swap them, or use Choice for a constant")
    if not math.isfinite(high - low):
        _refuse(kind, "high - low must be finite", "take a narrower range")
    if kind.log and low > 0 and not math.log(low) < math.log(high):
        _refuse(kind, "doubles cannot tell the logarithms of low and high apart", "drop log")


def _check_settings(kind: Any) -> None:
    if kind.unit is not None and not isinstance(kind.unit, str):
        _refuse(kind, f"unit must be a text, not {kind.unit!r}", 'write it as "deg"')
    for name in ("log", "periodic"):
        if not isinstance(getattr(kind, name, False), bool):
            value = getattr(kind, name)
            rule = f"{name} must be true or false, not {value!r}"
            _refuse(kind, rule, f"set {name} to true, without quotes, or leave it out")
    if kind.log and getattr(kind, "periodic", False):
        _refuse(kind, "a logarithm does not wrap around", "drop log or periodic")
    if getattr(kind, "periodic", False) and kind.step is not None:
        _refuse(kind, "a range with steps does not wrap around", "drop step or periodic")


def _last_on_grid(kind: Any, low: float, high: float, step: float) -> float:
    """Largest of low, low + step, ... that is at most high, but for rounding."""
    whole = isinstance(kind, Int)
    off = 0.0 if whole or step <= 0 else _off_grid(low, high, step)
    if not 0 < step <= (high - low) * (1 + off):
        remedy = "take a smaller step" if step > 0 else "take one above 0, or leave it out"
        _refuse(kind, f"step must lie in (0, high - low], not {step}", remedy)
    if kind.log and not whole:
        _refuse(kind, "a logarithm has no steps here", "drop log or step")
    if not math.isfinite((high + step / 2) - (low - step / 2)):
        rule = "high - low, with half a step beyond either end, must be finite"
        _refuse(kind, rule, "take a narrower range")
    if (high - low) / step >= _MOST_CELLS:
        remedy = "take a narrower range" if kind.log else "take a wider step"
        _refuse(kind, f"at most 2^40 values, not {(high - low) / step:.3g}", remedy)
    if whole:
        return low + (high - low) // step * step
    apart = _apart(low, high)
    if step < _LEAST_STEP * apart:
        rule = f"doubles there are {apart:.2g} apart, too far for a step of {step}"
        _refuse(kind, rule, "take a wider step, or a range near 0 and add the offset in render")
    return min(high, low + math.floor((high - low) / step + off) * step)


def _off_grid(low: float, high: float, step: float) -> float:
    """Part of a step by which a value may miss the grid: what rounding its digits can do."""
    return max(_OFF_GRID, 2 * _apart(low, high) / step)


def _apart(low: float, high: float) -> float:
    """Distance of two neighboring doubles where they are largest."""
    return math.ulp(max(abs(low), abs(high)))


def _check_choice(value: Any, others: dict[Any, int]) -> None:
    try:
        known = value in others
    except TypeError:
        kind = type(value).__name__
        raise SpaceError(
            f"a value of Choice must be hashable, not {value!r}; a {kind} is not: use a text or a "
            "tuple"
        ) from None
    if known:
        raise SpaceError(
            f"the values of Choice must differ, but {value!r} is there twice; drop one"
        )
    if value != value:
        raise SpaceError(f"a value of Choice must be equal to itself, not {value!r}; use a text")
