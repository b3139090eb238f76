"""Renders that say which pixels they draw: RGBA, or pairs of an image and its coverage."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.types import Float32
from fide_plugins.validation.images import as_target, is_image
from fide_plugins.validation.values import OnClip
from fide_plugins.views.views import Views


def is_pair(value: object) -> bool:
    """Whether it is a tuple of one image and its coverage (H, W)."""
    if not isinstance(value, tuple) or len(value) != 2:
        return False
    return is_image(value[0]) and getattr(value[1], "ndim", None) == 2


def without_coverage(images: Any, listed: bool = False) -> Any:
    """Renders as `FIDE.tell` takes them, images in place of pairs.

    listed: whether there is a list of them for each view.
    """
    if not isinstance(images, list | tuple):
        return images
    if listed:
        return [without_coverage(one) for one in images]
    return [one[0] if is_pair(one) else one for one in images]


def with_coverage(views: Views, images: Any, n: int, on_clip: OnClip) -> Float32:
    """Batch (n, H, W, 3) of renders, packed if there are several views; with a coverage, of 4.

    Raises ImageError.
    """
    if not views.listed:
        parts = [images]
    elif isinstance(images, list | tuple) and len(images) == len(views.views):
        parts = list(images)
    else:
        return views.as_batch(images, n, on_clip)  # raises, or takes what is packed
    covers = [_coverage(one, view.size) for one, view in zip(parts, views.views, strict=True)]
    batch = views.as_batch(without_coverage(images, views.listed), n, on_clip)
    if all(cover is None for cover in covers):
        return batch
    four = []
    for given, colors, cover in zip(parts, views.split(batch), covers, strict=True):
        a = np.ones(colors.shape[:3], np.float32) if cover is None else cover
        is_alpha = cover is not None and not (isinstance(given, list | tuple) and has_pairs(given))
        shown = straight(colors, a) if is_alpha else colors
        four.append(np.concatenate([shown, a[..., None]], axis=-1))
    return views.pack(four, (n,))


def has_pairs(images: Iterable[Any]) -> bool:
    """Whether some of the renders are pairs of an image and its coverage."""
    return any(map(is_pair, images))


def _coverage(images: Any, size: tuple[int, int]) -> Float32 | None:
    """Coverage (n, H, W) of renders of one view, as `FIDE.tell` takes them; None without any.

    Raises ImageError for one that does not fit.
    """
    if not isinstance(images, list | tuple):
        covers = _alpha(images, batch=True)
        return None if covers is None else np.stack([_checked(one, size) for one in covers])
    pairs = has_pairs(images)
    found = [(one[1] if is_pair(one) else None) if pairs else _alpha(one) for one in images]
    if all(one is None for one in found):
        return None
    full = np.ones(size, np.float32)
    return np.stack([_checked(full if one is None else one, size) for one in found])


def straight(batch: Float32, coverage: Float32) -> Float32:
    """Colors (n, H, W, 3) of what was composited over white, where anything is covered."""
    a = coverage[..., None]
    colors: Float32 = np.where(a > 0, 1 - (1 - batch) / np.maximum(a, 1e-3), batch)
    return colors.clip(0, 1, out=colors)


def _alpha(image: Any, batch: bool = False) -> Any:
    """Alpha channel, the last of four, of an image or a batch; None if it has none."""
    if not hasattr(image, "shape") or not hasattr(image, "dtype"):
        return None
    array = image.detach().cpu().numpy() if hasattr(image, "detach") else np.asarray(image)
    if array.ndim != 3 + batch:
        return None
    if array.shape[-1] == 4:
        return array[..., 3]
    first = array[:, 0] if batch else array[0]
    return first * 0 + array[:, 3] if batch and array.shape[1] == 4 else None


def _checked(coverage: Any, size: tuple[int, int]) -> Float32:
    """Coverage (H, W) in [0, 1]; a render may overshoot."""
    shape = tuple(coverage.shape)
    if shape != tuple(size):
        raise ImageError(
            f"the coverage of a render must have the size of its image, {size}, got {shape}; "
            "resize it, or return RGBA"
        )
    if coverage.dtype.kind == "f":
        if not np.isfinite(coverage).all():
            raise ImageError("the coverage of a render must be finite, got NaN or infinity")
        coverage = np.clip(coverage, 0, 1)
    return as_target(coverage, what="the coverage")[..., 0].copy()
