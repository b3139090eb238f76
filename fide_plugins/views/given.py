"""Targets, masks and weights as a user gives them: one, or one for each view."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Number
from typing import NamedTuple

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.types import Float32, Mask
from fide_plugins.validation.images import as_pixels, as_target, is_image
from fide_plugins.validation.pixels import Pixels, ValueRange
from fide_plugins.views.view import View
from fide_plugins.views.weights import ALPHA, hidden_by, joined, read_weights

__all__ = ["Given", "is_list_of_images", "one_a_view", "opened", "read_given", "sizes_of"]


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
    product = joined(first, second, f"mask times weights{of}")
    return Given(what, pixels, product)


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
    """A list of masks or weights, one for each target; a single one is that of all of one size.

    name, given: the argument and its value, see `Views.read`; masks themselves are not read.

    Raises ImageError for another number of them, or a single one where the sizes differ.
    """
    k = len(targets)
    if given is None or (isinstance(given, str) and given == ALPHA):
        return [given] * k
    if not isinstance(given, list | tuple) or _is_nested(given):
        shapes = [picture.shape for picture in opened(targets, raw=True)]
        if len({shape[:2] for shape in shapes}) == 1:
            return [given] * k
        got = f"a single one, which needs views of one size, not {sizes_of(shapes)}"
    elif len(given) == k:
        return list(given)
    else:
        got = f"{len(given)} of them"
    raise ImageError(
        f"{name} must be a list with one entry for each of the {k} views, None for a view "
        f"without; got {got}"
    )


def _is_nested(given: Sequence[object]) -> bool:
    """Whether it is one mask as nested lists, H rows of W numbers; an entry of a list is none."""
    return len(given) > 0 and all(map(_is_row, given))


def _is_row(value: object) -> bool:
    if isinstance(value, list | tuple):
        return len(value) > 0 and all(map(_is_number, value))
    ndim = getattr(value, "ndim", None)
    return isinstance(ndim, int) and ndim == 1


def _is_number(value: object) -> bool:
    return isinstance(value, Number | np.bool_) or getattr(value, "ndim", None) == 0
