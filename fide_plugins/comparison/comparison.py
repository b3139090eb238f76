"""Adjusted images and their losses, for the views of a scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from fide_plugins.comparison.auto import (
    MOST,
    camera_blur,
    changed_light,
    has_other_colors,
    light_between,
)
from fide_plugins.comparison.light import (
    EXPOSURE,
    NONE,
    SHADING,
    Light,
    common_light,
    robust_factor,
    robust_light,
)
from fide_plugins.comparison.scale_space import blurred
from fide_plugins.losses.base import ImageLoss
from fide_plugins.runtime.opencv import cv2
from fide_plugins.runtime.schema import Schema, array, check, instance, maybe, real, row, text
from fide_plugins.types import Float32, Float64
from fide_plugins.views.views import View, Views

_SMALL = 28  # pixels of a side at which the light is found
_BACKGROUND = 0.6  # of the loss of the target with its pixels in another order
_SCALE = 0.7  # of the standard deviation of the target: scale of robust differences
_LEAST_SCALE = 0.15  # of the range of values


@dataclass(frozen=True)
class Compared:
    """What is compared with the target, of n renders.

    images: (n, H, W, 3), packed if there are several views.
    losses: (n,).
    light: of each render, one for each view; None where the light is not adjusted.
    """

    images: Float32
    losses: Float64
    light: list[list[Light]] | None


class Comparison:
    """How renders are compared with a target.

    views: of the target.
    loss: of views, such as `evaluation.loss_of(views, "mse")`.
    loss_at: makes the same loss for views whose targets are blurred; None: the loss is a user's own
        and knows one target; it gets the target with the blurred difference.
    light: "none", "exposure" or "shading": what of it is set aside.
    scale: of robust differences, in [0, 1] of the range of values; "auto": from the contrast of the
        target; None: differences count as they are.
    background: whether pixels that are not covered are explained by the target's colors.
    blur: standard deviation in pixels at which `compare` compares if it is not told otherwise.
    camera: standard deviation in pixels by which the target is softer than renders, which are
        blurred as much.
    common: the light of each view that all renders have, see `light`; None: each has its own.
    least: of each view the differences (H, W, 3) from the target that are the least in each pixel,
        of all renders; None before the first.
    """

    def __init__(
        self,
        views: Views,
        loss: ImageLoss,
        loss_at: Callable[[Views], ImageLoss] | None = None,
        *,
        light: str = NONE,
        scale: float | str | None = None,
        background: bool = False,
        blur: float = 0.0,
        camera: float = 0.0,
        common: list[Light] | None = None,
        least: list[Float32] | None = None,
    ) -> None:
        if not getattr(loss, "of_places", True):  # differences of pixels say nothing
            light, scale = NONE, None
        self.views, self._loss, self._loss_at = views, loss, loss_at
        self.light, self.scale, self.background, self.blur = light, scale, background, blur
        self.camera, self.common, self.least = camera, common, least
        self._levels: dict[float, _Level] = {}

    @property
    def options(self) -> dict[str, Any]:
        """Keyword arguments of the constructor, as they are now."""
        names = ("light", "scale", "background", "blur", "camera")
        return {name: getattr(self, name) for name in names}

    def state_dict(self) -> dict[str, Any]:
        """What changes."""
        common = None if self.common is None else [vars(one) for one in self.common]
        return {
            "light": self.light, "blur": self.blur, "camera": self.camera, "common": common,
            "least": self.least,
        }  # fmt: skip

    def at(self, blur: float | None = None) -> _Level:
        """The target at a blur, None: at the present one, with its loss."""
        blur = self.blur if blur is None else blur
        if blur not in self._levels:
            self._levels[blur] = _Level(self, blur)
        return self._levels[blur]

    def compare(self, images: Float32, blur: float | None = None) -> Compared:
        """Adjusted images of renders, with their losses.

        images: (n, H, W, 3), packed if there are several views; (n, H, W, 4) with coverage.
        blur: standard deviation in pixels; None: the present one.
        """
        level = self.at(blur)
        made: Float32 = np.empty((*images.shape[:3], 3), np.float32)
        lights: list[list[Light]] = []
        hidden = np.zeros(len(images))
        for i, image in enumerate(images):
            parts = self.views.split(image[None])
            adjusted, light = [], []
            for one, part in zip(level.each, parts, strict=True):
                x, found, free = one.adjusted(part[0])
                adjusted.append(x)
                light.append(found)
                hidden[i] += free / len(parts)
            made[i] = self.views.pack(adjusted)
            if light[0] is not None:
                lights.append(light)  # type: ignore[arg-type]
        losses = level.loss.compute(made)
        if hidden.any():
            losses = losses + hidden * level.free
        return Compared(made, losses, lights or None)

    def note(self, adjusted: Float32) -> None:
        """Note of each pixel the least difference of any render; adjusted: as it is compared."""
        for image in adjusted:
            parts = zip(self.views.split(image[None]), self.at().each, strict=True)
            apart = [part[0] - one.shown for part, one in parts]
            pairs = zip(apart, apart if self.least is None else self.least, strict=True)
            self.least = [np.where(_squares(a) < _squares(b), a, b) for a, b in pairs]

    @property
    def floor(self) -> float:
        """Loss of the picture in which each pixel is that of the render nearest there."""
        if self.least is None:
            return 0.0
        level = self.at()
        seen = [one.shown + apart for one, apart in zip(level.each, self.least, strict=True)]
        return float(level.loss.compute(self.views.pack(seen)[None])[0])

    def begin_again(self, images: Float32) -> None:
        """Compare in another light from now on; images: the best renders (n, H, W, C)."""
        self.common, self.least = None, None
        if self.light == NONE or images.shape[3] == 4:
            return
        found = []
        for one, part in zip(self.at().each, self.views.split(images), strict=True):
            small = np.stack([_small(render) for render in part])
            found.append(common_light(small, one.small, one.small_weights, self.light))
        known = [light for light in found if light is not None]
        self.common = known if len(known) == len(found) else None

    def residual(self, image: Float32) -> list[Float32]:
        """Absolute difference (H, W) of each view, mean of the channels; image: (H, W, C)."""
        return [one.residual(x, cover) for _, one, x, cover in self._parts(image)]

    def _parts(
        self, image: Float32, blur: float | None = None
    ) -> Iterator[tuple[View, _OneView, Float32, Float32 | None]]:
        """Of each view: its target, and colors and coverage of an image (H, W, C)."""
        parts = self.views.split(image[None])
        for view, one, part in zip(self.views.views, self.at(blur).each, parts, strict=True):
            yield view, one, *_taken(part[0])

    def shown(self, image: Float32) -> Float32:
        """A render (H, W, C) in the light of the target, and over it where it covers nothing."""
        seen = []
        for view, one, colors, cover in self._parts(image, 0.0):
            x = one.lit(colors, cover)
            if self.light != NONE:
                x = np.clip(x, 0, 1)
            if cover is not None:
                x = view.target + _times(x - view.target, cover)
            seen.append(np.asarray(x, np.float32))
        return self.views.pack(seen)

    def leftovers(self, image: Float32) -> list[tuple[Float32, Float32, Float32 | None]]:
        """Of each view: the image (H, W, 3) in its light, the sharp target, weights (H, W)."""
        found = []
        for view, one, x, cover in self._parts(image, 0.0):
            weights = view.weights
            if cover is not None:
                weights = cover if weights is None else weights * cover
            found.append((one.lit(x, cover), view.target, weights))
        return found

    def has_other_colors(self, images: Float32) -> bool:
        """Whether the target's colors are none of these renders' (n, H, W, C): see `auto`."""
        if images.shape[3] == 4:
            return True  # what they do not cover has any color
        for one, part in zip(self.at().each, self.views.split(images), strict=True):
            counts = ... if one.small_weights is None else one.small_weights > 0
            target, *renders = (picture[counts] for picture in (one.small, *map(_small, part)))
            if has_other_colors(target, renders):
                return True
        return False

    def camera_blur(self, images: Float32) -> float:
        """By how much the target is softer than renders (n, H, W, C), in pixels: see `auto`.

        0 where pixels are hidden, or not covered: their borders are edges.
        """
        if images.shape[3] == 4 or any(view.weights is not None for view in self.views.views):
            return 0.0
        parts = zip(self.views.views, self.views.split(images), strict=True)
        return min(camera_blur(view.target, list(part)) for view, part in parts)

    def light_that_explains(self, images: Float32) -> str:
        """How much of the light differs, as the best renders (n, H, W, C) say: see `auto`."""
        level, found = self.at(), []
        for i, view in enumerate(level.each):
            parts = [self.views.split(image[None])[i][0] for image in images[:MOST]]
            taken = [_taken(part) for part in parts]
            small = [_small(render) for render, _ in taken]
            covers = [None if cover is None else _small(cover) for _, cover in taken]
            found.append(light_between(view.small, small, covers, view.small_weights, view.scale))
        return changed_light(self.light, np.mean(found, axis=0))


class _Level:
    """Target of a comparison at a blur.

    views: of the blurred targets.  loss: for these.
    """

    def __init__(self, comparison: Comparison, blur: float) -> None:
        views = comparison.views
        self.each = [_OneView(comparison, view, blur, i) for i, view in enumerate(views.views)]
        self.views, self.loss = views, comparison._loss
        if blur and comparison._loss_at is not None:
            shown = [
                View(one.target, view.weights)
                for one, view in zip(self.each, views.views, strict=True)
            ]
            self.views = Views(shown, listed=views.listed, values=views.values)
            self.loss = comparison._loss_at(self.views)
        for one, view in zip(self.each, self.views.views, strict=True):
            one.shown = view.target

    @cached_property
    def free(self) -> float:
        """Loss of a pixel that is not covered."""
        shuffled = [one.shuffled() for one in self.each]
        packed = self.views.pack(shuffled)
        return _BACKGROUND * float(self.loss.compute(packed[None])[0])


class _OneView:
    """Target of one view, of this number, at a blur.

    scale: of robust differences; None: they count as they are.
    """

    def __init__(self, comparison: Comparison, view: View, blur: float, number: int) -> None:
        self._comparison, self._view, self._blur, self._number = comparison, view, blur, number
        self.target = blurred(view.target, blur)
        self.shown = self.target
        self.small_weights = None if view.weights is None else _small(view.weights)
        self.scale = comparison.scale if not isinstance(comparison.scale, str) else _scale(view)

    @cached_property
    def small(self) -> Float32:
        """Sharp target at which the light is found."""
        return _small(self._view.target)

    def adjusted(self, image: Float32) -> tuple[Float32, Light | None, float]:
        """A render (H, W, C), its light, and the share of pixels that it does not cover."""
        coverage, light = None, None
        if image.shape[-1] == 4:
            image, coverage = _taken(image)
        if self._comparison.light != NONE:
            light = self.light(image, coverage)
        y = image if light is None else light.applied(image)
        apart = blurred(y, float(np.hypot(self._blur, self._comparison.camera))) - self.target
        factor = None if self.scale is None else robust_factor(apart, self.scale)  # (H, W)
        free = 0.0
        if coverage is not None:
            a = blurred(coverage, self._blur)
            free = 1 - float(np.average(a, weights=self._view.weights))
            root = np.sqrt(a)
            factor = root if factor is None else factor * root
        if factor is not None:
            apart = _times(apart, factor)
        apart += self.shown
        return apart, light, free

    def residual(self, image: Float32, coverage: Float32 | None) -> Float32:
        """What is left of a render (H, W, 3) in its light, (H, W)."""
        y = self.lit(image, coverage)
        left = np.abs(blurred(y, self._blur) - self.target).mean(axis=-1)
        if coverage is not None:
            left *= blurred(coverage, self._blur)
        if self._view.weights is not None:
            left *= np.sqrt(self._view.weights)
        return np.asarray(np.clip(left, 0, 1), np.float32)

    def lit(self, image: Float32, coverage: Float32 | None) -> Float32:
        """A render (H, W, 3) in its light, as soft as the target."""
        if self._comparison.light != NONE:
            image = self.light(image, coverage).applied(image)
        return blurred(image, self._comparison.camera)

    def light(self, image: Float32, coverage: Float32 | None) -> Light:
        """Light in which a render (H, W, 3) is nearest to the target, or that all have."""
        if self._comparison.common is not None:
            return self._comparison.common[self._number]
        kind, weights = self._comparison.light, self._view.weights
        if coverage is not None:
            weights = coverage if weights is None else weights * coverage
        if weights is None:
            return robust_light(_small(image), self.small, None, kind, self.scale)
        small = _small(weights)
        render, target = (_weighted(one, weights, small) for one in (image, self._view.target))
        return robust_light(render, target, small, kind, self.scale)

    def shuffled(self) -> Float32:
        """Target with its pixels in another order, as a render that is compared."""
        pixels = self.target.reshape(-1, 3)
        order = np.random.default_rng(0).permutation(len(pixels))
        apart = pixels[order].reshape(self.target.shape) - self.target
        if self.scale is not None:
            apart = _times(apart, robust_factor(apart, self.scale))
        return self.shown + apart


def _squares(apart: Float32) -> Float32:
    """Squared length (H, W, 1) of differences (H, W, 3)."""
    return np.asarray(np.square(apart).sum(axis=-1, keepdims=True), np.float32)


def _scale(view: View) -> float:
    """Scale of robust differences, by the contrast of a target."""
    seen = view.target if view.hidden is None else view.target[~view.hidden]
    deviation = float(np.sqrt(seen.reshape(-1, 3).var(axis=0, dtype=np.float64).mean()))
    return max(_SCALE * deviation, _LEAST_SCALE)


def _times(image: Float32, factor: Float32) -> Float32:
    """An image (H, W, 3) times a factor (H, W)."""
    return np.asarray(cv2.multiply(image, cv2.merge([factor, factor, factor])), np.float32)


def checked(state: Mapping[str, Any], views: Views) -> Mapping[str, Any]:
    """The state of a comparison with these views; ValueError if it is none."""
    least = maybe(row(*(array(*view.size, 3) for view in views.views)))
    light = instance(Light, {"gain": array("k", "k", 3), "offset": array(3), "curve": array(3)})
    schema: Schema = {
        "light": text,
        "blur": real(0.0),
        "camera": real(0.0),
        "common": maybe(row(*[light] * len(views.views))),
        "least": least,
    }
    found: dict[str, Any] = check(state, schema, {}, "comparison")
    if found["light"] not in (NONE, EXPOSURE, SHADING):
        raise ValueError(f"{found['light']!r} is no light")
    return found


def _taken(image: Float32) -> tuple[Float32, Float32 | None]:
    """Colors (H, W, 3) and coverage (H, W) of an image (H, W, C)."""
    if image.shape[-1] == 3:
        return image, None
    return np.ascontiguousarray(image[..., :3]), np.ascontiguousarray(image[..., 3])


def _weighted(image: Float32, weights: Float32, small: Float32) -> Float32:
    """As `_small`, the weighted mean of an image (H, W, 3); weights: (H, W), and (h, w)."""
    inverse = np.asarray(1 / np.maximum(small, 1e-6), np.float32)
    return _times(_small(_times(image, weights)), inverse)


def _small(image: Float32) -> Float32:
    """An image (H, W, C) or (H, W), averaged to at most 28 x 28 pixels."""
    height, width = image.shape[:2]
    size = min(width, _SMALL), min(height, _SMALL)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)
