"""Rules for the values of options: each takes an option's name and value, and returns the value.

All raise OptionError (a ValueError) that names the option, its value and the rule.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from itertools import pairwise
from typing import Any, TypeAlias

from fide_plugins.errors import OptionError
from fide_plugins.validation.points import as_real, whole_number

Rule: TypeAlias = Callable[[str, Any], Any]

_MOST_STEPS = 1000


def check_names(options: Collection[str], arguments: Iterable[str], instead: str) -> None:
    """Refuse options that the caller gives itself; instead: what each is, to end the error."""
    for name in arguments:
        if name in options:
            raise OptionError(f"{name} {instead}")


def whole(low: int, high: int | None = None, note: str = "") -> Rule:
    """A whole number from `low` to `high`; `note` ends the error for a larger one."""

    def rule(name: str, value: Any) -> int:
        number = whole_number(name, value, low)
        if high is not None and number > high:
            raise OptionError(f"{name} must be at most {high:,}, not {number:,}; {note}")
        return number

    return rule


def whole_numbers(name: str, value: Any) -> tuple[int, ...]:
    """One positive whole number or several, as a tuple."""
    several = value if isinstance(value, tuple | list) else (value,)
    return tuple(whole_number(f"each of {name}", number, 1) for number in several)


def groups(name: str, value: Any) -> tuple[tuple[int, ...], ...]:
    """Lists of parameter numbers; what they must be is known when the dimension is."""
    try:
        return tuple(tuple(whole_number(f"each of {name}", i, 0) for i in group) for group in value)
    except TypeError as error:
        rule = f"{name} must be lists of parameter numbers, such as [[0, 1], [2, 3]]"
        raise OptionError(f"{rule}; got {value!r}") from error


def one_of(*choices: str) -> Rule:
    """One of `choices`."""

    def rule(name: str, value: Any) -> str:
        if value not in choices:
            raise OptionError(f"{name} must be one of {', '.join(choices)}, not {value!r}")
        return str(value)

    return rule


def text(meaning: str) -> Rule:
    """A string; `meaning` describes it in the error."""

    def rule(name: str, value: Any) -> str:
        if not isinstance(value, str):
            raise OptionError(f"{name} must be {meaning}, not {value!r}")
        return value

    return rule


def switch(name: str, value: Any) -> bool:
    """True or False."""
    if not isinstance(value, bool):
        raise OptionError(f"{name} must be True or False, not {value!r}")
    return value


def _real(rule: str, sound: Callable[[float], bool]) -> Callable[[str, Any], float]:
    """A finite number for which `sound` holds; rule: what it must, in words."""

    def check(name: str, value: Any) -> float:
        number = as_real(value)
        if number is None or not (math.isfinite(number) and sound(number)):
            raise OptionError(f"{name} must {rule}, not {value!r}")
        return number

    return check


positive = _real("be a positive number", lambda number: number > 0)
positive_fraction = _real("lie in (0, 1]", lambda number: 0 < number <= 1)
not_negative = _real("be a finite number, not negative", lambda number: number >= 0)
fraction = _real("lie in [0, 1]", lambda number: 0 <= number <= 1)


def fraction_or(word: str) -> Rule:
    """A number in (0, 1], or the word."""
    number = _real(f"be a number in (0, 1] or {word!r}", lambda number: 0 < number <= 1)
    return lambda name, value: value if value == word else number(name, value)


def schedule(name: str, value: Any) -> tuple[float, ...]:
    """Noise levels, see `denoiser.training.euler`; at most 1,000."""
    try:
        times = tuple(float(t) for t in value)
    except (TypeError, ValueError, OverflowError):
        times = ()
    if not times or not all(b < a < math.inf for a, b in pairwise((*times, 0.0))):
        raise OptionError(
            f"{name} is a decreasing sequence of positive times, such as (0.3, 0.2, 0.1); "
            f"got {value!r}"
        )
    whole(1, _MOST_STEPS, "3 are published")("steps", len(times))
    return times


def parse_key_value(text: str) -> tuple[str, Any]:
    """Key and value of ``key=value``, the value as bool, int, float or str, whichever fits first.

    A value in brackets is a list, as JSON has it, ``groups=[[0,1],[2,3]]``, and one in braces a
    dictionary, ``x0={"azimuth": 30}``.

    Raises OptionError (a ValueError) for anything else.

    >>> [parse_key_value(text) for text in ("popsize=50", "sigma0=1e-1", "loss=mse", "fast=true")]
    [('popsize', 50), ('sigma0', 0.1), ('loss', 'mse'), ('fast', True)]
    """
    key, equals, value = text.partition("=")
    if not equals or not key.isidentifier():
        raise OptionError(f"key=value, not {text!r}")
    words: dict[str, Any] = {"true": True, "false": False}
    if value.lower() in words:
        return key, words[value.lower()]
    if value.startswith(("[", "{")):
        try:
            return key, json.loads(value)
        except ValueError as error:
            raise OptionError(
                f"{text!r}: a value in brackets is a list such as [[0,1],[2,3]], one in braces a "
                f'dictionary such as {{"azimuth": 30}} ({error})'
            ) from error
    for kind in (int, float):
        with suppress(ValueError):
            return key, kind(value)
    return key, value


_UNITS = {"d": 86400.0, "h": 3600.0, "m": 60.0, "s": 1.0}
_DURATION = re.compile("".join(rf"(?:(?P<{unit}>\d+(?:\.\d+)?){unit})?" for unit in _UNITS))


def seconds_of(name: str, value: object) -> float:
    """Seconds of a duration: a number of them, or a text such as "90s", "10m" or "1h30m".

    >>> seconds_of("time", "1h30m"), seconds_of("time", 12)
    (5400.0, 12.0)
    """
    seconds = as_real(value)
    if isinstance(value, str) and (text := value.strip().lower()):
        if found := _DURATION.fullmatch(text):
            seconds = sum(float(n) * _UNITS[unit] for unit, n in found.groupdict().items() if n)
        else:
            with suppress(ValueError):
                seconds = float(text)
    if seconds is None or not 0 < seconds < math.inf:
        raise OptionError(
            f"{name} must be a positive number of seconds, or a text such as '90s', '10m' or "
            f"'1h30m', not {value!r}"
        )
    return seconds
