"""Durations as people write them."""

from __future__ import annotations

import math
import re

from fide_plugins.errors import OptionError
from fide_plugins.validation.points import as_real

__all__ = ["seconds_of"]

_UNITS = {"d": 86400.0, "h": 3600.0, "m": 60.0, "s": 1.0}
_FORM = re.compile("".join(rf"(?:(?P<{unit}>\d+(?:\.\d+)?){unit})?" for unit in _UNITS))


def seconds_of(name: str, value: object) -> float:
    """Seconds of a duration: a number of them, or a text such as "90s", "10m" or "1h30m".

    name: of the option, for the message.  Raises OptionError (a ValueError) unless it is positive
    and finite.

    >>> seconds_of("time", "1h30m"), seconds_of("time", 12)
    (5400.0, 12.0)
    """
    seconds = _of_text(value.strip().lower()) if isinstance(value, str) else as_real(value)
    if seconds is None or not 0 < seconds < math.inf:
        raise OptionError(
            f"{name} must be a positive number of seconds, or a text such as '90s', '10m' or "
            f"'1h30m', not {value!r}"
        )
    return seconds


def _of_text(text: str) -> float:
    found = _FORM.fullmatch(text)
    if found is not None and text:
        return sum(float(n) * _UNITS[unit] for unit, n in found.groupdict().items() if n)
    try:
        return float(text)
    except ValueError:
        return math.nan
