"""Notices a renderer that does not use its parameters: all its images are equal."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from fide_plugins.runtime.messages import warn_user
from fide_plugins.types import Float64

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

    A run that was loaded does not know.

    Where losses differ, they were told beside the images and judge something else: nothing is said.
    generation: candidates of a generation, of which each counts before anything is said.
    """

    def __init__(self, generation: int) -> None:
        self._enough = max(generation, _LEAST)
        self._points: set[bytes] | None = set()  # None: two images differ, or it is not known
        self._image: Any = None
        self._loss = 0.0

    @property
    def number(self) -> int:
        """How many candidates have the same image, if these are enough to say so; 0 otherwise.

        Beyond some 10,000 no more are counted.
        """
        number = 0 if self._points is None else len(self._points)
        return number if number >= self._enough else 0

    def forget(self) -> None:
        """Say nothing from now on."""
        self._points = self._image = None

    def note(self, points: Float64, images: Any, losses: Float64) -> None:
        """Note images (n, H, W, 3), or None, and losses (n,) of points (n, d).

        Warns once if all are equal.
        """
        if self._points is None or not len(points):
            return
        if images is None:  # of these candidates nothing is known
            self.forget()
            return
        if self._image is None:
            image = images[0]
            self._image = image.clone() if isinstance(image, torch.Tensor) else image.copy()
            self._loss = float(losses[0])
        one_device = _device(images) == _device(self._image)
        with np.errstate(over="ignore"):  # of the largest numbers
            close = np.isclose(losses, self._loss, rtol=_RELATIVE, atol=_ABSOLUTE).all()
        if not (one_device and close and bool((abs(images - self._image) <= _ROUNDING).all())):
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


def _device(images: Any) -> object:
    """Device of a tensor; None of an array."""
    return images.device if isinstance(images, torch.Tensor) else None
