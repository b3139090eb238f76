"""Targets and weights of the views of a scene, as a user gives them and as they are compared.

Several views are *packed*: all pixels of all views, in order, as one picture (P, 1, 3).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.runtime.schema import array, check, real, row
from fide_plugins.types import Float32, Float64, Mask
from fide_plugins.validation.images import alpha_of, as_batch, as_pixels, as_target, is_image
from fide_plugins.validation.values import (
    AUTO,
    OnClip,
    Pixels,
    ValueRange,
    range_of,
    restored,
    value_range_of,
)

ALPHA = "alpha"
"""In place of a mask: the alpha channel of the target."""
DIGITS = 5e-7  # by which values in [0, 1] may differ in single precision
_SHADES = 8  # steps of a channel of the color that hidden pixels get
_LEVELS = (255.0, 65535.0)  # of 8 and 16 bits
_FEWEST = 100  # whole values of a range that are steps, and not just few values


# -- what a user gives -----------------------------------------------------------------------------


def is_list_of_images(value: object) -> bool:
    """Whether it is a list or tuple of pictures, rather than one picture of nested lists."""
    listed = isinstance(value, list | tuple) and len(value) > 0
    return listed and all(is_image(each) for each in value)  # type: ignore[attr-defined]


def _opened(target: object, raw: bool = False) -> list[Pixels]:
    """Arrays (H, W, C) of a picture or a list of them, with the values they have."""
    if not is_list_of_images(target):
        return [as_pixels(target, "the target", raw)]
    assert isinstance(target, list | tuple)
    return [as_pixels(one, f"the target of view {i}", raw) for i, one in enumerate(target)]


def _sizes_of(shapes: Sequence[Sequence[int]]) -> str:
    """Height x width of each view."""
    return " + ".join(f"{height} x {width}" for height, width, *_ in shapes)


def one_a_view(name: str, given: object, targets: Sequence[object]) -> list[object]:
    """Masks or weights, one for each target; a single one is that of all, if these have one size.

    Raises ImageError for another number of them.
    """
    k = len(targets)
    if given is None or (isinstance(given, str) and given == ALPHA):
        return [given] * k
    if isinstance(given, list | tuple):
        if len(given) == k:
            return list(given)
        got = f"{len(given)} of them"
    else:
        shapes = [picture.shape for picture in _opened(targets, raw=True)]
        if len({shape[:2] for shape in shapes}) == 1:
            return [given] * k
        got = f"a single one, which needs views of one size, not {_sizes_of(shapes)}"
    raise ImageError(
        f"{name} must be a list with one entry for each of the {k} views, None for a view "
        f"without; got {got}"
    )


def read_weights(given: object, target: object, size: tuple[int, int], what: str) -> Float32 | None:
    """Weights (H, W) in [0, 1] of a picture, of which the largest is 1; None if all are equal.

    given: a gray picture of that size (times its alpha), "alpha" for that of the target, or None.
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
    """Product of two weights (H, W), the largest 1; None if equal.  ImageError for zeros."""
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


# -- one view --------------------------------------------------------------------------------------


def _hidden_by(weights: Float32) -> Mask | None:
    """Pixels (H, W) of weight 0; None if there are none."""
    return None if weights.all() else weights == 0


@dataclass(frozen=True, eq=False)
class View:
    """One view: target (H, W, 3), and weights (H, W) in [0, 1], None where all are 1."""

    target: Float32
    weights: Float32 | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        return self.target.shape[0], self.target.shape[1]

    @cached_property
    def mean_weight(self) -> float:
        """Mean of the weights."""
        return 1.0 if self.weights is None else float(self.weights.mean(dtype=np.float64))

    @cached_property
    def hidden(self) -> Mask | None:
        """(H, W), pixels of weight 0, where a render may have any values; None: all count."""
        return None if self.weights is None else _hidden_by(self.weights)

    @cached_property
    def _roots(self) -> Float32:
        assert self.weights is not None
        return np.sqrt(self.weights)[..., None]

    @cached_property
    def filled(self) -> Float32:
        """Target whose hidden pixels have the mean color of all others, (H, W, 3).

        The color is rounded, since remembered tokens are compared with those of the next target
        (`retarget`), which mostly has the same rounded one.
        """
        if self.hidden is None:
            return self.target
        filled = self.target.copy()
        mean = self.target[~self.hidden].mean(axis=0, dtype=np.float64)
        filled[self.hidden] = np.round(mean * _SHADES) / _SHADES
        filled.flags.writeable = False
        return filled

    def shown(self, batch: Float32) -> Float32:
        """What encoder and named loss see of renders (n, H, W, 3): `blended` with `filled`."""
        return self._blended(batch, self.filled)

    def blended(self, batch: Float32) -> Float32:
        """What a user's own loss, which may know the target, sees: x' = t + sqrt(w) (x - t)."""
        return self._blended(batch, self.target)

    def _blended(self, batch: Float32, t: Float32) -> Float32:
        if self.weights is None:
            return batch
        roots = self._roots
        with np.errstate(under="ignore"):  # a tiny difference times a weight
            return np.where(roots == 1, batch, t + roots * (batch - t))

    def difference(self, image: Float32, other: Float32) -> Float64:
        """Difference of two images, (H, W, 3), whose mean square is the weighted one."""
        apart = np.subtract(image, other, dtype=np.float64)
        if self.weights is not None:
            apart *= self._roots / self.mean_weight**0.5
        return apart

    @property
    def counted(self) -> int:
        """How many pixels count at all."""
        return int(np.prod(self.size) if self.weights is None else np.count_nonzero(self.weights))

    @cached_property
    def contrast(self) -> float:
        """Range of the target's values where they count, in the color in which it is largest."""
        return float(np.ptp(self._seen(self.target), axis=0).max())

    def is_rounded(self, levels: float) -> bool:
        """Whether all values of the target that count are whole multiples of 1 / levels."""
        steps = self._seen(self.target).astype(np.float64) * levels
        return bool((abs(steps - np.round(steps)) <= levels * DIGITS).all())

    def _seen(self, image: Float32) -> Float32:
        """Pixels (m, 3) that count."""
        return image[... if self.hidden is None else ~self.hidden].reshape(-1, 3)


# -- all views -------------------------------------------------------------------------------------


class Views:
    """The views of a scene, at least one.

    listed: whether the target was a list, so that renders are, too.
    plain: whether there is one view without weights, given as such.
    values: those of a user's images that are 0 and 1 here; None: 0 and 1.
    """

    def __init__(
        self, views: Sequence[View], *, listed: bool, values: ValueRange | None = None
    ) -> None:
        self.views, self.listed, self.values = tuple(views), listed, values
        self.plain = not listed and views[0].weights is None
        for view in views:
            view.target.flags.writeable = False

    @classmethod
    def read(
        cls,
        target: object,
        mask: object = None,
        weights: object = None,
        value_range: object = None,
    ) -> Views:
        """Views from what a user passes, see `FIDE`.

        target: a picture, any input of `as_target`, or a list of them; or views, as they are.
        mask, weights: None; (H, W) in [0, 1], any gray picture, "alpha" for the target's own alpha
            channel; for a list of targets also a list with one of them for each view.

        Raises ImageError, naming the view; OptionError for what is no range.
        """
        values = None if value_range is None else value_range_of(value_range)
        if isinstance(target, Views) and mask is None and weights is None and values is None:
            return target
        listed = is_list_of_images(target)
        if not listed and (is_list_of_images(mask) or is_list_of_images(weights)):
            raise ImageError("a list of masks or weights needs a list of targets, one for each")
        pictures, given = _opened(target, values is not None), []
        masks = one_a_view("mask", mask, target) if listed else [mask]  # type: ignore[arg-type]
        others = one_a_view("weights", weights, target) if listed else [weights]  # type: ignore[arg-type]
        for i, (pixels, one, other) in enumerate(zip(pictures, masks, others, strict=True)):
            of = f" of view {i}" if listed else ""
            size = pixels.shape[0], pixels.shape[1]
            made: Float32 | None = None
            if one is not None or other is not None:
                first = read_weights(one, pixels, size, f"mask{of}")
                second = read_weights(other, pixels, size, f"weights{of}")
                made = joined(first, second, f"mask times weights{of}")
            given.append(made)
        hidden = [None if one is None else _hidden_by(one) for one in given]
        if values == AUTO:
            values = range_of(zip(pictures, hidden, strict=True))
        assert not isinstance(values, str)
        views = []
        for i, pixels in enumerate(pictures):
            what = f"the target of view {i}" if listed else "the target"
            picture = as_target(pixels, what=what, hidden=hidden[i], values=values)
            views.append(View(picture, given[i]))
        return cls(views, listed=listed, values=values)

    def retargeted(self, target: object) -> Views:
        """The same views and weights for the next picture, or list; ImageError for other sizes."""
        listed = is_list_of_images(target)
        pictures = _opened(target, self.values is not None)
        sizes = _sizes_of([picture.shape for picture in pictures])
        if (listed, sizes) != (self.listed, self.sizes):
            raise ImageError(
                f"the next target must have the size of the first, {self.sizes}, not "
                f"{sizes}: resize it, or make another optimizer"
            )
        next_one = pictures if listed else pictures[0]
        return Views.read(next_one, weights=self.weights, value_range=self.values)

    @property
    def canonical(self) -> Views:
        """The same for images in [0, 1], as `as_batch` returns them."""
        return self if self.values is None else Views(self.views, listed=self.listed)

    def restored(self, image: Any) -> Any:
        """An image in [0, 1], or a list of them, in the user's values."""
        return restored(image, self.values)

    @property
    def value_range(self) -> tuple[float, float] | None:
        """Values of a user's images that are 0 and 1 here; None: 0 and 1."""
        return None if self.values is None else (self.values.low, self.values.high)

    @cached_property
    def target(self) -> Float32:
        """Packed target (P, 1, 3); one view that is not listed, (H, W, 3)."""
        return self.pack([view.target for view in self.views], ())

    @property
    def targets(self) -> Any:
        """In [0, 1]: (H, W, 3), or a list of them."""
        targets = [view.target for view in self.views]
        return targets if self.listed else targets[0]

    @property
    def weights(self) -> Any:
        """Mask times weights: (H, W) or None, or a list of them."""
        weights = [view.weights for view in self.views]
        return weights if self.listed else weights[0]

    @cached_property
    def version(self) -> str:
        """Ends the version of encoder and loss, whose values depend on sizes and weights."""
        if self.plain:
            return ""
        digest = hashlib.blake2b(digest_size=4)
        for view in self.views:
            digest.update(b"-" if view.weights is None else view.weights.tobytes())
        return f", views {self.sizes}, weights {digest.hexdigest()}"

    @property
    def sizes(self) -> str:
        """Height x width of each view."""
        return _sizes_of([view.size for view in self.views])

    def as_batch(self, images: object, n: int | None, on_clip: OnClip) -> Float32:
        """Renders of n candidates, (n, H, W, 3), packed if there are several views.

        images: as `FIDE.tell` takes them, or what this method returned.  n: None for as many as
            there are.
        Raises ImageError, naming the view, its shape and the rule.
        """
        if n is None:
            first = images[0] if self.listed and isinstance(images, list | tuple) else images
            n = len(first) if hasattr(first, "__len__") else 0
        if not self.listed:
            hidden, values, size = self.views[0].hidden, self.values, self.target.shape
            return as_batch(images, size, n=n, on_clip=on_clip, hidden=hidden, values=values)
        if isinstance(images, np.ndarray) and images.shape == (n, *self.target.shape):
            return as_batch(images, self.target.shape, n=n, on_clip=on_clip)  # packed
        if not isinstance(images, list | tuple) or len(images) != len(self.views):
            got = f"{len(images)} entries" if isinstance(images, list | tuple) else "no list"
            shape = f", of shape {images.shape}" if isinstance(images, np.ndarray) else ""
            raise ImageError(
                f"images must be a list of {len(self.views)} batches (n, H, W, C), one for each "
                f"view, {self.sizes}; got {got}{shape}; renders candidate by candidate become that "
                "by list(zip(*images))"
            )
        made = [self._one_batch(i, batch, n, on_clip) for i, batch in enumerate(images)]
        return self.pack(made, (n,))

    def _one_batch(self, i: int, batch: object, n: int, on_clip: OnClip) -> Float32:
        """Renders of one of several views; errors name it."""
        view = self.views[i]
        try:
            return as_batch(
                batch, view.size, n=n, on_clip=lambda clip: on_clip(clip.of_view(i)),
                hidden=view.hidden, values=self.values,
            )  # fmt: skip
        except ImageError as error:
            raise type(error)(f"view {i}: {error}") from error

    def split(self, batch: Float32) -> list[Float32]:
        """Renders (n, H, W, 3) of each view."""
        if not self.listed:
            return [batch]
        parts, start = [], 0
        for height, width in (view.size for view in self.views):
            part = batch[:, start : start + height * width]
            parts.append(np.ascontiguousarray(part).reshape(len(batch), height, width, -1))
            start += height * width
        return parts

    def unpacked(self, image: Float32 | None) -> Any:
        """Image (H, W, 3) of a candidate; a list of them for a list of targets."""
        if image is None or not self.listed:
            return image
        return [part[0] for part in self.split(image[None])]

    def squared_error(self, image: Float32) -> float:
        """Mean over the views of the weighted mean squared difference of a packed image."""
        return float(np.mean([np.square(d).mean() for d in self.differences(image, self.target)]))

    def differences(self, image: Float32, other: Float32) -> list[Float64]:
        """Difference (H, W, 3) of two packed images in each view, see `View.difference`."""
        parts = zip(self.views, self.split(image[None]), self.split(other[None]), strict=True)
        return [view.difference(one[0], two[0]) for view, one, two in parts]

    @cached_property
    def roundings(self) -> list[float]:
        """Largest error of rounding in the target of each view: half a step; 0: not rounded."""
        levels = list(_LEVELS)
        if self.values is not None and self.values.span >= _FEWEST:
            levels.append(self.values.span)
        return [next((0.5 / n for n in levels if one.is_rounded(n)), 0.0) for one in self.views]

    @cached_property
    def numbers(self) -> int:
        """How many values of pixels count: three a pixel where the target has colors, else one."""
        gray = all((view.target == view.target[..., :1]).all() for view in self.views)
        return sum(view.counted for view in self.views) * (1 if gray else 3)

    def pack(self, pictures: Sequence[Float32], leading: tuple[int, ...] = ()) -> Float32:
        """One array of pictures (..., H, W, C), one for each view."""
        if not self.listed:
            return pictures[0]
        flat = [one.reshape(*leading, -1, 1, one.shape[-1]) for one in pictures]
        return np.concatenate(flat, axis=len(leading))

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> Views:
        """Views of saved `target`, `weights` and `value_range`; a target in [0, 1], or views."""
        target = settings["target"]
        if isinstance(target, Views):
            return target
        made = cls.read(target, weights=settings["weights"])
        values = value_range_of(settings.get("value_range"))
        assert not isinstance(values, str)
        return cls(made.views, listed=made.listed, values=values)

    @staticmethod
    def check_settings(settings: Mapping[str, Any]) -> None:
        """Raise ValueError unless `target`, `weights` and `value_range` can be of saved views."""
        target, weights = settings["target"], settings["weights"]
        if settings.get("value_range") is not None:
            check(list(settings["value_range"]), row(real(), real()), {}, "value_range")
            value_range_of(settings["value_range"])
        listed = isinstance(target, list)
        if listed and not (target and isinstance(weights, list) and len(weights) == len(target)):
            raise ValueError("weights are not one for each target")
        pairs = zip(target, weights, strict=True) if listed else [(target, weights)]
        for picture, weight in pairs:
            sides: dict[str, int] = {}
            check(picture, array("H", "W", 3, low=0.0, high=1.0), sides, "target")
            if weight is not None:
                check(weight, array("H", "W", low=0.0, high=1.0), sides, "weights")
