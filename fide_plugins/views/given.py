"""Targets, masks and weights as a user gives them: one, or one for each view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.types import Float32, Mask
from fide_plugins.validation.images import alpha_of, as_pixels, as_target, is_image
from fide_plugins.validation.pixels import Pixels, ValueRange
from fide_plugins.views.view import View, hidden_by

__all__ = [
    "ALPHA",
    "Given",
    "is_list_of_images",
    "joined",
    "one_a_view",
    "opened",
    "read_given",
    "read_weights",
    "sizes_of",
]

ALPHA = "alpha"
"""In place of a mask: the alpha channel of the target."""


def is_list_of_images(value: object) -> bool:
    """Whether it is a list or tuple of pictures, rather than one picture of nested lists."""
    listed = isinstance(value, list | tuple) and len(value) > 0
    return listed and all(is_image(each) for each in value)  # type: ignore[attr-defined]


class Given(NamedTuple):
    """Target of one view as it was given.

    what: its name in errors.
    pixels: (H, W) or (H, W, C), with the values that they have.
    weights: (H, W), mask times weights; None: all pixels count.
    """

    what: str
    pixels: Pixels
    weights: Float32 | None

    @property
    def seen(self) -> tuple[Pixels, Mask | None]:
        """Pixels (H, W, C), and those of them that are hidden."""
        pixels = self.pixels if self.pixels.ndim == 3 else self.pixels[..., None]
        return pixels, hidden_by(self.weights)

    def view(self, values: ValueRange | None) -> View:
        """The view; values: those that become 0 and 1.  Raises ImageError."""
        hidden = hidden_by(self.weights)
        target = as_target(self.pixels, what=self.what, hidden=hidden, values=values)
        return View(target, self.weights)


def read_given(target: object, mask: object, weights: object, of: str, raw: bool) -> Given:
    """One view; `of` names it in errors; raw: whether its values are any numbers."""
    if is_list_of_images(mask) or is_list_of_images(weights):
        raise ImageError("a list of masks or weights needs a list of targets, one for each")
    what = f"the target{of}"
    pixels = as_pixels(target, what, raw)
    size = pixels.shape[0], pixels.shape[1]
    first = read_weights(mask, pixels, size, f"mask{of}")
    second = read_weights(weights, pixels, size, f"weights{of}")
    return Given(what, pixels, joined(first, second, f"mask times weights{of}"))


def opened(target: object, raw: bool = False) -> list[Pixels]:
    """Arrays (H, W) or (H, W, C) of a picture or a list of them, with the values they have.

    raw: whether these are any numbers.
    """
    if not is_list_of_images(target):
        return [as_pixels(target, "the target", raw)]
    assert isinstance(target, list | tuple)
    return [as_pixels(one, f"the target of view {i}", raw) for i, one in enumerate(target)]


def sizes_of(shapes: Sequence[Sequence[int]]) -> str:
    """Height x width of each view."""
    return " + ".join(f"{height} x {width}" for height, width, *_ in shapes)


def one_a_view(name: str, given: object, targets: Sequence[object]) -> list[object]:
    """A list of masks or weights, one for each target; a single one is that of all.

    name, given: the argument and its value, see `Views.read`; masks themselves are not read.

    Raises ImageError for another number of them, or a single one where the sizes differ.
    """
    k = len(targets)
    if given is None or (isinstance(given, str) and given == ALPHA):
        return [given] * k
    if isinstance(given, list | tuple):
        if len(given) == k:
            return list(given)
        got = f"{len(given)} of them"
    else:
        shapes = [picture.shape for picture in opened(targets, raw=True)]
        if len({shape[:2] for shape in shapes}) == 1:
            return [given] * k
        got = f"a single one, which needs views of one size, not {sizes_of(shapes)}"
    raise ImageError(
        f"{name} must be a list with one entry for each of the {k} views, None for a view "
        f"without; got {got}"
    )


def read_weights(given: object, target: object, size: tuple[int, int], what: str) -> Float32 | None:
    """Weights (H, W) in [0, 1] of a picture, of which the largest is 1; None if all are equal.

    given: a gray picture, any input of `as_target`, of that size, gray times alpha where it is
        transparent; "alpha" for the alpha channel of the target; None.
    what: its name in errors.

    Raises ImageError: wrong size, colors, values outside [0, 1], NaN, or zeros everywhere.
    """
    if given is None:
        return None
    if isinstance(given, str) and given == ALPHA:
        try:
            weights = alpha_of(target, f"the target of {what}='alpha'")
        except ImageError as error:
            raise ImageError(f"{error}; or give a {what} of its own, {what}=ARRAY") from error
    else:
        picture = as_target(given, what=what, size=size, behind=0.0)
        weights = picture[..., 0].copy()
        if (picture != weights[..., None]).any():
            raise ImageError(f"{what} must be gray, (H, W), but it has colors; pass one channel")
    return joined(weights, None, what)


def joined(a: Float32 | None, b: Float32 | None, what: str) -> Float32 | None:
    """Product of two weights (H, W), None for ones, of which the largest becomes 1.

    None if all are equal.  Raises ImageError for zeros everywhere.
    """
    if a is None and b is None:
        return None
    product = np.asarray((1 if a is None else a) * (1 if b is None else b))
    largest = product.max()
    if largest <= 0:
        raise ImageError(
            f"{what} is zero everywhere, so no pixel of the picture counts; white is what counts, "
            "black or transparent what is hidden"
        )
    if product.min() == largest:
        return None
    weights: Float32 = np.ascontiguousarray(product / largest, np.float32)
    return weights
