"""What explains a residual that no parameter removes: light, blur, clutter or texture.

Each explains the share of the squared difference that it removes: another light or a blur of the
render, a small part of the pixels, fine structure.  The image of a local optimum differs in the
last two, too, so these are named only where several searches ended at the same answer.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.comparison.light import SHADING, fit_light
from fide_plugins.comparison.scale_space import blurred
from fide_plugins.types import Float32, Float64

_EXPLAINED = 0.6, 0.8  # share of the squared difference: where searches agree, and elsewhere
_LEAST = 0.02  # root mean square of a difference that is worth a word
_BLURS = (0.7, 1.0, 1.5, 2.0, 3.0)  # standard deviations in pixels
_FEW = 0.2  # of the pixels, which clutter covers at most
_FINE = 2.0  # pixels, standard deviation of the filter that removes texture
_REMEDIES = {
    "light": 'photometric="auto" sets it aside',
    "blur": "render with the blur of the camera, or give it a parameter",
    "clutter": 'robust="auto" lets it count less, mask= leaves it out',
    "texture": 'loss="texture" compares what does not depend on where things are',
}
_WORDS = {
    "light": "another light",
    "blur": "a blur of the target",
    "clutter": "things in a small part of the picture that the renderer does not draw",
    "texture": "fine structure that the renderer does not draw as it is",
}


def explanation(
    image: Float32,
    target: Float32,
    weights: Float32 | None,
    *,
    agreed: bool,
    adjusts: tuple[bool, bool] = (False, False),
) -> str | None:
    """What explains most of the difference of an image and a target, (H, W, 3) each, in words.

    weights: (H, W), which pixels count; None: all.
    agreed: whether several searches ended at this image.
    adjusts: whether light and clutter are set aside already.

    None where the difference is small, or where nothing explains most of it.
    """
    if weights is not None and not weights.any():
        return None  # a render that covers nothing
    total = _square(image - target, weights)
    if total < _LEAST**2:
        return None
    shares = {
        "light": _light(image, target, weights, total),
        "blur": 1 - min(_square(blurred(image, b) - target, weights) for b in _BLURS) / total,
    }
    if agreed:
        shares["clutter"] = _clutter(image - target, weights)
        shares["texture"] = 1 - _square(blurred(image - target, _FINE), weights) / total
    cause = max(shares, key=shares.__getitem__)
    if shares[cause] < _EXPLAINED[not agreed]:
        return None
    light, robust = adjusts
    remedy = _REMEDIES[cause]
    if (cause == "light" and light) or (cause == "clutter" and robust):
        remedy = "look at result.residual: where is it?"
    return (
        f"What is left (root mean square {total**0.5:.2g}) is no noise, and the renderer cannot "
        f"draw it: {_WORDS[cause]} explains {shares[cause]:.0%} of it; {remedy}."
    )


def _light(image: Float32, target: Float32, weights: Float32 | None, total: float) -> float:
    lit = fit_light(image, target, weights, SHADING).applied(image)
    return 1 - _square(lit - target, weights) / total


def _clutter(apart: Float32, weights: Float32 | None) -> float:
    """Share of the squared difference in the pixels that differ most."""
    squares: Float64 = np.square(apart, dtype=np.float64).mean(axis=-1)
    if weights is not None:
        squares = squares * weights
    ordered = np.sort(squares, axis=None)
    return float(ordered[-max(1, int(_FEW * ordered.size)) :].sum() / ordered.sum())


def _square(apart: Float32, weights: Float32 | None) -> float:
    squares = np.square(apart, dtype=np.float64).mean(axis=-1)
    return float(np.average(squares, weights=weights))
