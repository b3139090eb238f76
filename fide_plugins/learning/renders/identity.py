"""Whether what renders now is what rendered before: the version that it states, and its images.

A model that learns images of two renderers learns neither.  So before renders are added to a
folder, some of those that are there are rendered again.  That also notices what no fingerprint of
the source knows: what it imports, the files it reads, the version of a program.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fide_plugins.errors import OptionError, RenderError
from fide_plugins.fitting.rendering import Failed
from fide_plugins.learning.renders.renderer import BatchRenderer, Pixels, resized
from fide_plugins.learning.renders.store import RenderStore
from fide_plugins.runtime.registry import changed, check_version, fingerprint_of, version_of
from fide_plugins.types import Float64, Mask

__all__ = ["check_images", "version_for"]

_POINTS = 8  # of which every second one decides where nothing is noisy
_AGAIN = 4  # renders of each for its noise
_SEED = 2**80  # between the seeds of noise of those renders
_ROUNDING = 1  # of 255: other processors round otherwise
_FLIPPED = 1e-3  # of all values: without antialiasing, rounding puts an edge into the next pixel
_NOISY = 2.0  # times the noise: by chance 2 of 1,000 checks exceed it where noise is one number an
# image (an exposure), and none of 1,000 where it is of pixels; 7 of 300 where 60 % of renders fail
_COARSE = 8  # pixels along a side that are averaged: the noise of single pixels hides little there


def version_for(renderer: BatchRenderer, version: str | None) -> str | None:
    """Version that was given, or else the one that the renderer states.

    Raises OptionError unless both are the same text, where there are both.
    """
    given = check_version(version, "version")
    own = version_of(renderer.source)
    if given is not None and own is not None and given != own:
        raise OptionError(
            f"version is {given!r}, and the renderer {renderer.name} states {own!r}: leave out "
            "version, or change that of the renderer"
        )
    return own if given is None else given


def check_images(store: RenderStore, renderer: BatchRenderer, more: bool) -> None:
    """Raise OptionError if the renderer's images are no longer those of a store.

    more: whether the store's images will be learned together with new ones.  Without, nothing is
        rendered unless a version is stated for the first time, or the source of the renderer was
        changed and no version vouches for it.

    Four renders where nothing has changed, nothing is noisy and at most half of them fail;
    otherwise 32 more, and RenderError if three in four of these fail.  OSError if the folder cannot
    be written.  Not noticed is what changes less than a thousandth of all values, such as a small
    object, or less than the noise.
    """
    now = fingerprint_of(renderer.source)
    stated = store.settings.get("version") != store.version
    vouched = store.version is not None  # the store compares versions itself
    if more or stated or (not vouched and changed(store.fingerprint, now)):
        x, seeds, images = store.examples(_POINTS)
        if len(x):
            _compare(store, renderer, x, seeds, images)
    if stated or (now is not None and now != store.fingerprint):
        store.accept(now or store.fingerprint)


def _compare(
    store: RenderStore, renderer: BatchRenderer, x: Float64, seeds: Sequence[int], images: Pixels
) -> None:
    """Raise OptionError if images (n, H, W, 3) of points (n, d) are not those of the renderer."""
    few = slice(None, None, 2)
    drawn, _ = _images(store, renderer, x[few], [seeds[few]])
    enough = _present(drawn).mean() >= 0.5
    if enough and _equal(drawn[0], images[few]):
        return
    again = [[seed + k * _SEED for seed in seeds] for k in range(1, 1 + _AGAIN)]
    drawn, failure = _images(store, renderer, x, again)
    if _present(drawn).sum() <= len(x):  # with more there is a point with two, which tell the noise
        raise RenderError(
            f"{renderer.name} failed for most parameters that were rendered again, of which "
            f"{store.folder} has images; mend the renderer, or delete the folder if it is of "
            f"another one: {failure}"
        )
    if not enough and _equal(drawn, images):
        return
    fine = _distances(images, drawn)
    coarse = _distances(_averaged(images), np.array([_averaged(some) for some in drawn]))
    for difference, noise in (fine, coarse):
        if difference > _NOISY * noise:
            raise OptionError(
                f"the renderer's images are not those in {store.folder}: they differ by "
                f"{difference:.2g} of 255 on average, and its noise is {noise:.2g}; delete the "
                "folder, or learn into another file"
            )


def _images(
    store: RenderStore, renderer: BatchRenderer, x: Float64, seeds: Sequence[Sequence[int]]
) -> tuple[Float64, str | None]:
    """Images (k, n, H, W, 3) in units of 1 / 255 of points (n, d), and why a render failed, if any.

    seeds: of the noise, (k, n).  An image whose render failed is NaN.
    """
    images, failure = np.full((len(seeds), len(x), *store.size, 3), np.nan), None
    for some, of_seed in zip(images, seeds, strict=True):
        for place, image in zip(some, renderer.small(x, of_seed, store.size), strict=True):
            if isinstance(image, Failed):
                failure = image.reason
            else:
                place[:] = image
    return images, failure


def _present(images: Float64) -> Mask:
    """Which images (..., H, W, 3) are there, (...)."""
    return ~np.isnan(images[..., 0, 0, 0])


def _equal(one: Float64, other: Pixels) -> bool:
    """Whether images (..., n, H, W, 3) that are there are (n, H, W, 3) but for rounding."""
    differences = np.abs(one - other)[_present(one)]
    return float((differences > _ROUNDING).mean()) <= _FLIPPED


def _distances(stored: Float64 | Pixels, drawn: Float64) -> tuple[float, float]:
    """Mean difference of stored images (n, ...) from new ones (k, n, ...), and of the new ones."""
    pairs = [drawn[i] - drawn[j] for i in range(len(drawn)) for j in range(i)]
    return float(np.nanmean(np.abs(drawn - stored))), float(np.nanmean(np.abs(pairs)))


def _averaged(images: Float64 | Pixels) -> Float64:
    """Images (n, h, w, 3) of the means of neighboring pixels of (n, H, W, 3)."""
    height, width = (-(-side // _COARSE) for side in images.shape[1:3])
    small = [resized(image.astype(np.float32), (height, width)) for image in images]
    return np.array(small, np.float64)
