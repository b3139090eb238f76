"""Notices a renderer that does not use its parameters: all its images are equal."""

from __future__ import annotations

import numpy as np

from fide_plugins.runtime.messages import warn_user
from fide_plugins.types import Float32, Float64

_LEAST = 32  # candidates, which lie around the start, so that a parameter may show only elsewhere
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
        self._first: tuple[Float64, Float32, float] | None = None  # point, image and loss
        self._count: int | None = 0  # None: two images differ, or it is not known
        self._moved = False  # whether there are two different points

    @property
    def number(self) -> int:
        """How many candidates have the same image; 0: too few to say so."""
        count = self._count if self._moved else 0
        return count if count and count >= self._enough else 0

    def forget(self) -> None:
        """Say nothing from now on."""
        self._count = self._first = None

    def note(self, points: Float64, images: Float32 | None, losses: Float64) -> None:
        """Note images (n, H, W, 3) and losses (n,) of points (n, d); warns once if all are equal.

        images: None: nothing is known of these candidates.
        """
        if self._count is None or not len(points):
            return
        if images is None:
            self.forget()
            return
        if self._first is None:
            self._first = points[0].copy(), images[0].copy(), float(losses[0])
        point, image, loss = self._first
        with np.errstate(over="ignore"):  # of the largest numbers
            close = np.isclose(losses, loss, rtol=_RELATIVE, atol=_ABSOLUTE).all()
        if not (close and (abs(images - image) <= _ROUNDING).all()):
            self.forget()
            return
        known, self._count = self.number, self._count + len(points)
        self._moved = self._moved or bool((points != point).any())
        if self.number and not known:
            warn_user(
                f"all images of the first {self.number} candidates are equal: no parameter has "
                "changed the image so far; does render use its parameters, and do their ranges "
                "change what is seen? (Elsewhere in the box images may differ.)"
            )
