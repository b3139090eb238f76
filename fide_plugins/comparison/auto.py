"""Whether a light or a camera's blur tells the target from the renders.

A free light brings any two pictures nearer to each other.  So it is set aside only where it
explains more than half of what is left beyond what it explains between the best renders, which
have the same light; never where renders have the target's colors: then parameters change them, or
nothing does.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from fide_plugins.comparison.light import EXPOSURE, NONE, SHADING, robust_factor, robust_light
from fide_plugins.comparison.scale_space import blurred
from fide_plugins.types import Float32, Float64

MOST = 4  # renders that are looked at
_KINDS = (NONE, EXPOSURE, SHADING)
_EXPLAINED = 0.5  # of what is left without a light, at most, with it
_NO_LONGER = 1.05  # times what is left with a light, at most, without it
_LEVELS = np.linspace(0.05, 0.95, 9)  # quantiles of each channel
_FARTHER, _STEP = 4.0, 0.004  # times the usual distance of other colors, and beyond it
_SIGMAS = 0.8, 1.6  # pixels: edges are compared behind these filters
_STEEPEST = (0.9, 0.95, 0.98)  # quantiles of the gradients
_BLURS = (0.0, 0.4, 0.6, 0.8, 1.0, 1.3, 1.7, 2.2)  # pixels
_LOOKED_AT, _SURE, _LEAST_BLUR = 8, 2.0, 0.6  # renders, their standard deviations, pixels
_NO_EDGE = -0.05  # softness of an edge behind a blur of 4 pixels: what is softer is a shade
_NARROWEST = 8  # pixels of a side in which there are edges
_NOTHING = 1e-7  # mean square that is rounding


def light_between(
    target: Float32,
    renders: Sequence[Float32],
    covers: Sequence[Float32 | None],
    weights: Float32 | None,
    scale: float | None,
) -> Float64:
    """(2, 3): what is left without and with light ("exposure", "shading"), robust mean squares.

    Between the target and the nearest render, and between renders (median).  All images are small.
    covers: (h, w), what the renders cover; None: all.
    """
    counted = [_product(weights, cover) for cover in covers]
    left = [_left(one, target, w, scale) for one, w in zip(renders, counted, strict=True)]
    pairs = [
        _left(renders[i], renders[j], _product(counted[i], covers[j]), scale)
        for i, j in permutations(range(len(renders)), 2)
    ]
    between = np.median(pairs, axis=0) if pairs else np.ones(3)
    return np.array([np.min(left, axis=0), between])


def changed_light(light: str, left: Float64) -> str:
    """Light that is set aside from now on; left: (2, 3), see `light_between`."""
    to_target, between = left
    usual = np.minimum(1, (between + _NOTHING) / (between[0] + _NOTHING))
    now = _KINDS.index(light)
    if now and to_target[0] <= _NO_LONGER * to_target[now]:
        return NONE
    for other in (1, 2):
        if other <= now:
            continue
        before = to_target[:other].min() if other > 1 else to_target[0]
        share = to_target[other] / max(before, _NOTHING)
        if before > _NOTHING and share < _EXPLAINED * usual[other]:
            now = other
    return _KINDS[now]


def has_other_colors(target: Float32, renders: Sequence[Float32]) -> bool:
    """Whether quantiles of a target's colors are far from those of all renders, (..., 3) each.

    Far is what is four times as far as a render's from those of the most similar render.
    """
    if len(renders) < 3:
        return True
    pictures = [one.reshape(-1, 3) for one in (target, *renders)]
    found = np.array([np.quantile(one, _LEVELS, axis=0).ravel() for one in pictures])
    apart = np.sqrt(np.square(found[:, None] - found).mean(axis=2))
    np.fill_diagonal(apart, np.inf)
    usual = float(np.median(apart[1:, 1:].min(axis=1)))
    return bool(apart[0].min() > _FARTHER * usual + _STEP)


def camera_blur(target: Float32, renders: Sequence[Float32]) -> float:
    """Blur in pixels that gives renders edges as soft as the target's, (H, W, 3) each; 0: none."""
    seen = renders[:_LOOKED_AT]
    if len(seen) < 3 or min(target.shape[:2]) < _NARROWEST:
        return 0.0
    own = _softness(target)
    if own > _NO_EDGE:
        return 0.0
    soft = np.array([[_softness(blurred(one, b)) for b in _BLURS] for one in seen])
    mean = soft.mean(axis=0)
    if own < mean[0] + _SURE * float(soft[:, 0].std()):
        return 0.0
    found = float(np.interp(own, np.maximum.accumulate(mean), _BLURS))
    return found if found >= _LEAST_BLUR else 0.0


def _softness(image: Float32) -> float:
    """Logarithm of how steep the steepest edges stay behind a filter."""
    steep = []
    for sigma in _SIGMAS:
        filtered = blurred(image, sigma)
        across, down = np.diff(filtered, axis=1)[:-1], np.diff(filtered, axis=0)[:, :-1]
        squares = (np.square(across) + np.square(down)).sum(axis=-1)
        steep.append(float(np.sqrt(np.quantile(squares, _STEEPEST)).mean()))
    return float(np.log((steep[1] + _NOTHING) / (steep[0] + _NOTHING)))


def _left(
    render: Float32, target: Float32, weights: Float32 | None, scale: float | None
) -> list[float]:
    """Weighted robust mean squares that are left without light, with exposure, with shading."""
    left = []
    for kind in _KINDS:
        y = render
        if kind != NONE:
            y = robust_light(render, target, weights, kind, scale).applied(render)
        squares = np.square(y - target).mean(axis=-1)
        if scale is not None:
            squares *= np.square(robust_factor(y - target, scale))
        whole = 1.0 if weights is None else max(float(weights.mean()), 1e-6)
        left.append(float((squares if weights is None else squares * weights).mean()) / whole)
    return left


def _product(one: Float32 | None, other: Float32 | None) -> Float32 | None:
    if one is None or other is None:
        return other if one is None else one
    product: Float32 = one * other
    return product
