"""Another value of an integer or a choice: all other parameters adapt before the loss decides.

A search settles on a value while the rest of the picture is still wrong, and later no small step
leaves it: with another floor, or one column more, the image is worse until the camera has moved.
So the incumbent is rendered once with each other value, and a search of its own begins at the most
promising one.  Each combination of values gets its turn before any is searched again.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.search.moves.base import NARROW, Known, Move, Start
from fide_plugins.types import Float64

__all__ = ["ChangeValue"]

_WIDTH = 1 / 4  # of sigma0, in numbers: they adapt to the value


class ChangeValue(Move):
    """The incumbent with another value of one integer or choice."""

    name = "change value"
    prior_gain = 0.5
    has_more = False

    def possible(self, known: Known) -> bool:
        """Whether an integer or a choice has another value."""
        return len(known.values.others(known.here.x)) > 0

    def draw(self, known: Known, n: int, rng: np.random.Generator) -> Float64:
        """Copies (n or fewer, d) of the incumbent, with values that were searched least often."""
        others = known.values.others(known.here.x)
        searches = known.values.searches(others)
        least = others[searches == searches.min()]
        return least if len(least) <= n else rng.permutation(least)[:n]

    def begin_at(self, known: Known, x: Float64) -> Start:
        """Hold the value that was changed; be narrow in all others, and wider in numbers."""
        width = np.where(known.values.discrete, NARROW, _WIDTH)
        held = np.zeros(known.dim, bool)
        held[known.axes.together(np.flatnonzero(x != known.here.x))] = True
        held &= known.values.discrete  # x may be another point of the user's, with other numbers
        return Start(x, width * known.sigma0, held=held)

    def note_begun(self, known: Known, x: Float64) -> None:
        """Count a search with the values of x (d,)."""
        known.values.note(x)
