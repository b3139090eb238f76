"""A user's function, or a task, as a renderer of points of the unit cube."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from inspect import signature
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from fide_plugins.errors import ImageError, OptionError, RenderError
from fide_plugins.fitting.rendering import Failed, attempt
from fide_plugins.runtime.opencv import cv2
from fide_plugins.runtime.registry import own_name
from fide_plugins.space import Space
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.images import as_target
from fide_plugins.validation.points import number_of_parameters

__all__ = [
    "BatchRenderer",
    "Pixels",
    "Small",
    "as_renderer",
    "pixels_of",
    "resized",
    "same_aspect",
    "small_size",
]

Pixels = npt.NDArray[np.uint8]
Small: TypeAlias = Pixels | Failed
"""An image (H, W, 3) as a store has it, or why there is none."""

_OTHERS = 4  # points that are tried where the renderer fails in the middle of the cube
_ASPECT = 0.02  # relative difference of height / width that is rounding


@dataclass(frozen=True)
class BatchRenderer:
    """What renders several points.

    source: a function of one point, or an object with `render(X)` for a batch.  It gets arrays of
        its own, since it may change them.
    space: names of the parameters; None: the function gets a point of the cube.
    dim: d.
    name: of the function, or of the task.
    shape: height and width of its images; others of that aspect are taken, too.  None: of any.
    """

    source: Any
    space: Space | None
    dim: int
    name: str
    shape: tuple[int, int] | None = None

    @property
    def periodic(self) -> tuple[bool, ...]:
        """(d,), axes that wrap around."""
        if self.space is None:
            return (False,) * self.dim
        return tuple(bool(each) for each in self.space.periodic)

    def small(self, X: Float64, seeds: Sequence[int], size: tuple[int, int]) -> list[Small]:
        """Images of the points X (n, d), resized to (height, width); of one that failed a `Failed`.

        seeds: (n,), of the noise of each, for a source whose `render` takes them.
        A batch that fails as a whole is rendered point by point.

        Each image of a function, or of a task whose `piece` is 1, is made small before the next one
        is rendered: full ones take much memory, and a renderer may draw all of them into one array.
        """
        if not hasattr(self.source, "render"):
            return [self._small(attempt(partial(self._one, x), _briefly), size) for x in X]
        if getattr(self.source, "piece", None) != 1:
            batch = attempt(
                lambda: [self._small(image, size) for image in self._batch(X, seeds)], _briefly
            )
            if not isinstance(batch, Failed):
                return batch
        return [
            self._small(attempt(partial(self._single, x, seed), _briefly), size)
            for x, seed in zip(X, seeds, strict=True)
        ]

    def _single(self, x: Float64, seed: int) -> Any:
        return self._batch(x[None], [seed])[0]

    def _batch(self, X: Float64, seeds: Sequence[int]) -> Any:
        if "seed" in signature(self.source.render).parameters:
            return self.source.render(X.copy(), seed=list(seeds))
        return self.source.render(X.copy())

    def _one(self, x: Float64) -> Any:
        return self.source(x.copy() if self.space is None else self.space.decode(x))

    def first_shape(self) -> tuple[int, int]:
        """Height and width of the image of the middle of the cube.

        Where that one fails, of the image of one of a few other points.  Raises RenderError if the
        renderer fails for all of them, ImageError if it gives no image.
        """
        try:
            return self._shape_at(np.full(self.dim, 0.5))
        except (RenderError, ImageError):
            for x in np.random.default_rng(0).random((_OTHERS, self.dim)):
                with suppress(RenderError, ImageError):
                    return self._shape_at(x)
            raise

    def _shape_at(self, x: Float64) -> tuple[int, int]:
        """Height and width of the image of a point; errors are those of the first, the middle."""
        try:
            batch = hasattr(self.source, "render")
            image = self.source.render(x[None])[0] if batch else self._one(x)
        except (Exception, SystemExit) as error:  # scripts end by sys.exit
            why = f"{type(error).__name__}: {error}"
            raise RenderError(
                f"{self.name} failed in the middle of the space, and at {_OTHERS} other points: "
                f"{why}"
            ) from error
        height, width, _ = self._canonical(image).shape
        return height, width

    def _canonical(self, image: Any) -> Float32:
        return as_target(image, what=f"the image of {self.name}")

    def _small(self, image: Any, size: tuple[int, int]) -> Small:
        if isinstance(image, Failed):
            return image
        try:
            whole = self._canonical(image)
        except ImageError as error:
            return Failed(str(error))
        height, width = whole.shape[:2]
        if self.shape is not None and not same_aspect((height, width), self.shape):
            return Failed(
                f"the image of {self.name} has {width} x {height} pixels (width x height), and "
                f"the first one had {self.shape[1]} x {self.shape[0]}"
            )
        return pixels_of(whole, size)


def _briefly(error: BaseException) -> Failed:
    """Failed render of an exception, without its traceback: there may be thousands."""
    return Failed(f"{type(error).__name__}: {error}")


def as_renderer(render: Any, space: Space | int | None) -> BatchRenderer:
    """Return the renderer for what a user gave; raises OptionError.

    render: function of a dictionary (with a `Space`) or of a point (d,), or a task.
    space: `Space`, or number of parameters; None: the task's own.
    """
    own = getattr(render, "space", None) or getattr(render, "dim", None)
    batch = hasattr(render, "render")
    if not batch and not callable(render):
        raise OptionError(f"render must be a function or a task, not {type(render).__name__}")
    if space is None and not batch:
        raise OptionError("a function needs its space: learn(render, space), or learn(render, dim)")
    space = own if space is None else space
    named = space if isinstance(space, Space) else None
    dim = named.dim if named is not None else number_of_parameters("space", space)
    if batch and getattr(render, "dim", dim) != dim:
        raise OptionError(f"the task has {render.dim} parameters, and the space {dim}")
    return BatchRenderer(render, named, dim, own_name(render))


def small_size(shape: tuple[int, ...], size: int) -> tuple[int, int]:
    """Height and width of images of this shape (H, W, ...) whose longer side becomes `size`."""
    scale = size / max(shape[:2])
    return max(1, round(shape[0] * scale)), max(1, round(shape[1] * scale))


def same_aspect(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two images (height, width) have one aspect, but for rounding."""
    change = (one[0] / one[1]) / (other[0] / other[1])
    return abs(math.log(change)) <= _ASPECT + 1 / min(*one, *other)


def resized(image: Float32, size: tuple[int, int]) -> Float32:
    """Image (H, W, 3) resized to (height, width), by means of areas where it shrinks."""
    if image.shape[:2] == size:
        return image
    shrinks = image.shape[0] >= size[0] and image.shape[1] >= size[1]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size[::-1], interpolation=how), np.float32)


def pixels_of(image: Float32, size: tuple[int, int]) -> Pixels:
    """Image (H, W, 3) resized to (height, width), as a store has it."""
    return np.rint(np.clip(resized(image, size), 0.0, 1.0) * 255).astype(np.uint8)
