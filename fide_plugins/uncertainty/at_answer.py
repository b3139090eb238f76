"""How sure an answer is, by renders around it: `std` that does not depend on the search's path."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fide_plugins.types import Float64

_ROUNDING = (1 / 255) ** 2 / 12
_PRIOR = 1 / 12  # variance of the uniform law on [0, 1]
_NUMBERS = 2_000_000  # of J, above which pictures are made smaller
_RIDGE = 1e-9
_MOST = 0.9  # of the residual's energy, which the parameters may have taken away
_TINY = 1e-150


def deviations_at(
    slopes: Sequence[Float64],
    residuals: Sequence[Float64],
    images: Sequence[Float64],
    weights: Sequence[Float64],
    together: Sequence[int] | None = None,
) -> Float64:
    """Standard deviations (p,), in units of the unit cube, by a linear model, to a factor of 2.

    With J (p, M), the slopes, and r (M,), the residual, the variance is

    1. of noise, and what the renderer cannot draw: A^-1 B A^-1, A = J J^T and B = J E[e e^T] J^T,
       of an error e with the correlations of r, by its spectrum (a sandwich, White 1982);
    2. plus the larger of (A^-1 J r)^2, which the search has left, and the square of the step with
       free light (gain and offset of each color, planes over the picture), less that by noise;
    3. at most that of the prior, uniform in the cube.  Rounding to 8 bits is the least error.

    slopes: (p, H, W, C) of each view, change of its image with a parameter over the unit cube.
    residuals: (H, W, C) of each view, target minus image.  Both are weighted.
    images: (H, W, C) of each view, not weighted; weights: (H, W, C), by which differences are.
    together: of each view, k, where its pixels are means of k x k pixels.
    """
    means_of = [1] * len(slopes) if together is None else together
    arrays = zip(slopes, residuals, images, weights, means_of, strict=True)
    views = [_view(*one, together=k) for *one, k in arrays]
    p = len(slopes[0])
    J = np.concatenate([view.slopes.reshape(p, -1) for view in views], axis=1)
    r = np.concatenate([view.residual.ravel() for view in views])
    energy = float(r @ r)
    variance = max(energy / len(r), min(view.rounding for view in views))
    A, prior = J @ J.T, variance / _PRIOR * np.eye(p)
    K = np.linalg.inv(A + prior)
    B = sum((_correlated(view) for view in views), np.zeros((p, p)))
    taken = min(float(np.trace(K @ B)) / max(energy, _TINY), _MOST)
    B = B / (1 - taken) + max(0.0, variance - energy / len(r)) * A
    spread = np.diag(K @ (B + variance * prior) @ K)
    left = np.square(K @ (J @ r))
    std: Float64 = np.sqrt(np.minimum(spread + np.maximum(_by_light(views, J, r, K), left), _PRIOR))
    return std


class _View(NamedTuple):
    """Arguments of `deviations_at` for one view; rounding: variance of a number by 8 bits."""

    slopes: Float64
    residual: Float64
    image: Float64
    weights: Float64
    rounding: float


def pixels_together(p: int, height: int, width: int, colors: int) -> int:
    """K, such that J has few enough numbers in means of k x k pixels."""
    numbers = p * height * width * colors
    return min(max(1, int(np.ceil((numbers / _NUMBERS) ** 0.5))), height, width)


def means(pixels: Float64, k: int) -> Float64:
    """Means of k x k pixels (..., H, W, C); what is left at the lower and right edge is dropped."""
    if k == 1:
        return pixels
    *leading, height, width, colors = pixels.shape
    h, w = height // k, width // k
    blocks = pixels[..., : h * k, : w * k, :].reshape(*leading, h, k, w, k, colors)
    reduced: Float64 = blocks.mean(axis=(-4, -2))
    return reduced


def _view(*arrays: Float64, together: int) -> _View:
    """The same in one color where all are equal."""
    if all((one == one[..., :1]).all() for one in arrays):
        arrays = tuple(one[..., :1] for one in arrays)
    slopes, residual, image, weights = arrays
    return _View(slopes, residual, image, weights, _ROUNDING / together**2)


def _correlated(view: _View) -> Float64:
    """J E[e e^T] J^T (p, p) of a view, with the correlations of its residual over all distances."""
    height, width, _ = view.residual.shape
    size = (2 * height, 2 * width)  # no pixel is a neighbor of one at the other edge
    of_residual = np.fft.rfft2(view.residual, size, axes=(0, 1))  # (2H, W + 1, C)
    of_slopes = np.fft.rfft2(view.slopes, size, axes=(1, 2))
    both = (of_slopes * of_residual.conj()).sum(axis=-1)  # (p, 2H, W + 1)
    twice = np.full(both.shape[-1], 2.0)
    twice[[0, -1]] = 1.0  # the others stand for their conjugates, too
    energy = np.einsum("ahw,bhw,w->ab", both, both.conj(), twice, optimize=True).real
    counted = float(view.weights.any(axis=-1).sum())
    B: Float64 = energy / (4 * height * width * max(counted, 1.0))
    return B


def _light(view: _View) -> list[Float64]:
    """Changes (H, W, C) of a view by gain and offset of each color, planes over the picture."""
    height, width, colors = view.image.shape
    v, u = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    changes = []
    for color in range(colors):
        for plane in (np.ones_like(u), u, v):
            for brightness in (1.0, view.image[..., color]):
                change = np.zeros_like(view.image)
                change[..., color] = plane * brightness
                changes.append(change * view.weights)
    return changes


def _by_light(views: Sequence[_View], J: Float64, r: Float64, K: Float64) -> Float64:
    """(p,), squared, how far the parameters would move with free light, by more than noise."""
    light, at = [], 0
    for view in views:
        for change in _light(view):
            light.append(np.zeros(len(r)))
            light[-1][at : at + change.size] = change.ravel()
        at += view.residual.size
    p, every = len(J), np.vstack([J, *light])
    normal = every @ every.T
    normal[:p, :p] += np.linalg.inv(K) - J @ J.T  # the prior
    scale = np.sqrt(np.maximum(np.diag(normal), _TINY))
    inverse = np.linalg.inv(normal / np.outer(scale, scale) + _RIDGE * np.eye(len(scale)))
    inverse /= np.outer(scale, scale)
    moved = inverse @ (every @ r)
    rest = r - moved @ every
    by_noise = float(rest @ rest) / len(r) * (np.diag(inverse)[:p] - np.diag(K))
    beyond: Float64 = np.square(moved[:p]) - np.maximum(by_noise, 0.0)
    return beyond
