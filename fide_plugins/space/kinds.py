"""What one parameter is: a number, a whole number, or one of several values.

Every kind maps its values to numbers, and `layout` maps numbers to the cube.  n whole numbers or
steps are n equal cells of an axis (with log: equal in the value).  A choice of n > 2 values has n
axes, of which the largest coordinate decides, since its values have no order; one of two has one.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, NamedTuple, TypeAlias

from fide_plugins.errors import SpaceError
from fide_plugins.validation.points import as_real, as_whole

_MOST_CELLS = 2**40  # of an axis; beyond, doubles do not tell the cells of a logarithmic axis apart
_LARGEST_INT = 2**44  # beyond, doubles do not tell the ends of cells well apart, nor logarithms
_MOST_CHOICES = 1000
_OFF_GRID = 1e-6  # of a step, by which a value may miss the grid
_LEAST_STEP = 16  # units in the last place of the largest value


class Scale(NamedTuple):
    """Numbers from low to high; with a step > 0 only low, low + step, ... up to high."""

    low: float
    high: float
    step: float
    log: bool


@dataclass(frozen=True, repr=False)
class _Number:
    """What `Float` and `Int` share: one axis, from low to high."""

    type: ClassVar[str]
    width: ClassVar[int] = 1
    low: Any
    high: Any
    unit: str | None = field(default=None, kw_only=True)
    log: bool = field(default=False, kw_only=True)
    step: Any = field(default=None, kw_only=True)

    def __repr__(self) -> str:
        """Return the expression that makes it, without what is as by default."""
        words = [repr(self.low), repr(self.high)]
        for each in fields(self)[2:]:
            if getattr(self, each.name) != each.default:
                words.append(f"{each.name}={getattr(self, each.name)!r}")
        return f"{type(self).__name__}({', '.join(words)})"

    @property
    def scale(self) -> Scale:
        """Its numbers."""
        return Scale(self.low, self.high, self.step or 0.0, self.log)

    def number(self, name: str, value: Any) -> float:
        """Number of a value; SpaceError, with the parameter's `name`, if it is none of its own."""
        number = as_real(value)
        if number is not None and self.low <= number <= self.high:
            steps = 0.0 if self.step is None else (number - self.low) / self.step
            if abs(steps - round(steps)) <= self._off_grid:
                return number
        raise SpaceError(
            f"parameter {name!r} must be a value of {self!r}, not {value!r}; change the value, or "
            "the parameter"
        )

    @property
    def _off_grid(self) -> float:
        """Part of a step by which a value may miss the grid: what rounding its digits can do."""
        return 0.0 if self.step is None else max(_OFF_GRID, 2 * self._apart / self.step)

    @property
    def _apart(self) -> float:
        """Distance of two neighboring doubles where they are largest."""
        return math.ulp(max(abs(self.low), abs(self.high)))

    def _convert(
        self, convert: Callable[[Any], float | None], most: float, rule: str, *names: str
    ) -> None:
        """Replace what was given for these names by its number."""
        for name in names:
            number = convert(getattr(self, name))
            if number is None or not abs(number) <= most:
                self._require(False, f"{name} must be {rule}, not {getattr(self, name)!r}")
            object.__setattr__(self, name, number)

    def _require(self, condition: bool, rule: str) -> None:
        if not condition:
            raise SpaceError(f"{self!r}: {rule}")

    def _check(self) -> None:
        """Raise SpaceError unless the range can be searched."""
        low, high, step, log, require = self.low, self.high, self.step, self.log, self._require
        require(self.unit is None or isinstance(self.unit, str), 'unit must be a text, as "deg"')
        require(isinstance(log, bool), "log must be true or false, without quotes")
        require(low < high, "low must be less than high; swap them, or use Choice for a constant")
        rule = "the logarithm needs low > 0, and ends that differ in it; raise low, or drop log"
        require(not log or (low > 0 and math.log(low) < math.log(high)), rule)
        half = 0 if step is None else step / 2
        rule = "high - low and a step must be finite; take a narrower range"
        require(math.isfinite((high + half) - (low - half)), rule)
        if step is None:
            return
        rule = "step must lie in (0, high - low]; take another one, or leave it out"
        require(0 < step <= (high - low) * (1 + abs(self._off_grid)), rule)
        rule = (
            "there may be at most 2^40 values, with steps 16 times as wide as doubles are apart "
            "there; take a wider step, or a narrower range near 0"
        )
        wide = isinstance(step, int) or step >= _LEAST_STEP * self._apart
        require((high - low) / step < _MOST_CELLS and wide, rule)
        steps = math.floor((high - low) / step + self._off_grid)
        object.__setattr__(self, "high", min(high, low + steps * step))


@dataclass(frozen=True, repr=False)
class Float(_Number):
    """A real number in [low, high].

    low, high: finite, low < high.
    unit: for people, such as "deg" or "m".
    log: whether its logarithm is searched; low must be above 0.
    step: only low, low + step, ... are meant; high becomes the last of them.  It must be at least
        16 times as wide as doubles are apart there.  None: every number.
    periodic: whether high is the same as low, as for an angle; the search wraps around.

    Raises SpaceError (a ValueError).
    """

    type: ClassVar[str] = "float"
    low: float
    high: float
    step: float | None = field(default=None, kw_only=True)
    periodic: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        names = ("low", "high") if self.step is None else ("low", "high", "step")
        self._convert(as_real, sys.float_info.max, "a finite number", *names)
        rule = "periodic must be true or false, without quotes"
        self._require(isinstance(self.periodic, bool), rule)
        several = bool(self.log) + self.periodic + (self.step is not None)
        self._require(several <= 1, "log, periodic and step do not go together; drop all but one")
        self._check()

    def value(self, number: float) -> float:
        """Value of a number of the scale."""
        return float(number)


@dataclass(frozen=True, repr=False)
class Int(_Number):
    """A whole number in [low, high], both included.

    low, high: whole, at most 2^44 from zero, low < high, at most 2^40 values.
    unit: for people.
    log: whether its logarithm is searched; low must be above 0, step 1.
    step: only low, low + step, ... are meant; high becomes the last of them.

    Raises SpaceError (a ValueError).
    """

    type: ClassVar[str] = "int"
    low: int
    high: int
    step: int = field(default=1, kw_only=True)

    def __post_init__(self) -> None:
        rule = "a whole number of at most 2^44 (Float takes real numbers)"
        self._convert(as_whole, _LARGEST_INT, rule, "low", "high", "step")
        rule = f"the logarithm needs step 1, not {self.step}; drop one of them"
        self._require(not self.log or self.step == 1, rule)
        self._check()

    @property
    def _off_grid(self) -> float:
        return 0.0

    def value(self, number: float) -> int:
        """Value of a number of the scale."""
        return int(number)


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
        if not 0 < len(values) <= _MOST_CHOICES:
            raise SpaceError(
                f"Choice needs 1 to {_MOST_CHOICES} values, not {len(values)}; write them one by "
                "one: Choice('a', 'b')"
            )
        try:
            index = {value: i for i, value in enumerate(values)}
        except TypeError as error:
            raise SpaceError(
                f"Choice takes values one by one, Choice('a', 'b'), not {values!r}: {error}"
            ) from None
        if len(index) < len(values) or any(value != value for value in values):
            raise SpaceError(
                f"the values of Choice must differ, and equal themselves, not {values!r}; drop one"
            )
        self.__dict__.update(values=values, _index=index)

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
        try:
            return float(self.__dict__["_index"][value])
        except (KeyError, TypeError):  # or not hashable
            raise SpaceError(
                f"parameter {name!r} must be one of {', '.join(map(repr, self.values))}, not "
                f"{value!r}; change the value, or the parameter"
            ) from None


Kind: TypeAlias = Float | Int | Choice
