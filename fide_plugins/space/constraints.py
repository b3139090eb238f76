"""What is valid: the conditions of a space, and a function of the user's own."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from numbers import Real
from textwrap import shorten
from typing import Any

import numpy as np

from fide_plugins.errors import OptionError, ProtocolError
from fide_plugins.runtime.registry import name_of
from fide_plugins.space.space import Space
from fide_plugins.types import Float64

__all__ = ["Constraints", "constraints_not_stored", "constraints_of"]

_VIOLATED = 1.0  # by how much, where a function says only that


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
