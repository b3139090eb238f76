"""Notices a renderer that does not use its parameters: all its images are equal."""

from __future__ import annotations

import numpy as np

from fide_plugins.runtime.messages import warn_user
from fide_plugins.types import Float32, Float64

__all__ = ["SameImages"]

_LEAST = 32
"""Candidates.  They lie around the start: of three parameters, one that changes the image above 0.7
of its axis alone changes none of the 32 in a sixth of all searches; above 0.9, in three of four.
"""
_MOST = 10_000  # candidates that are kept, and so counted
_ROUNDING = 2e-6  # a GPU renders the same image with other last bits: by 1e-7 to 1e-6
_RELATIVE, _ABSOLUTE = 1e-4, 1e-9  # by which losses of such images differ at most


class SameImages:
    """Whether all images that were told so far are equal, but for rounding on a GPU.

    A run that was loaded does not know.  Where losses differ, they were told beside the images and
    judge something else: nothing is said.

    generation: candidates of a generation, of which each counts before anything is said.
    """

    def __init__(self, generation: int) -> None:
        self._enough = max(generation, _LEAST)
        self._points: set[bytes] | None = set()  # None: two images differ, or it is not known
        self._first: tuple[Float32, float] | None = None  # image and loss

    @property
    def number(self) -> int:
        """How many candidates, up to some 10,000, have the same image; 0: too few to say so."""
        number = 0 if self._points is None else len(self._points)
        return number if number >= self._enough else 0

    def forget(self) -> None:
        """Say nothing from now on."""
        self._points = self._first = None

    def note(self, points: Float64, images: Float32 | None, losses: Float64) -> None:
        """Note images (n, H, W, 3) and losses (n,) of points (n, d); warns once if all are equal.

        images: None: nothing is known of these candidates.
        """
        if self._points is None or not len(points):
            return
        if images is None:
            self.forget()
            return
        image, loss = self._first = self._first or (images[0].copy(), float(losses[0]))
        with np.errstate(over="ignore"):  # of the largest numbers
            close = np.isclose(losses, loss, rtol=_RELATIVE, atol=_ABSOLUTE).all()
        if not (close and (abs(images - image) <= _ROUNDING).all()):
            self.forget()
            return
        known = self.number
        if len(self._points) < max(_MOST, self._enough):
            self._points.update(x.tobytes() for x in points)
        if self.number and not known:
            warn_user(
                f"all images of the first {self.number} different candidates are equal: no "
                "parameter has changed the image so far; does render use its parameters, and do "
                "their ranges change what is seen? (These candidates lie around the start of the "
                "search: elsewhere in the box images may differ.)"
            )
