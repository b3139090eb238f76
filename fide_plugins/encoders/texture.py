"""Encoder `texture`: one token, which says what a picture is made of, wherever it is.

After Heeger and Bergen (1995), and Portilla and Simoncelli (2000): quantiles of the colors along
nine directions of RGB; the logarithm of the mean power in bands of frequency and of three
orientations; sharpness of edges at four scales, and correlations of the colors.  They are those of
the mirrored picture, and nearly those of a shifted one.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache

import cv2
import numpy as np
import torch

from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.errors import ImageError
from fide_plugins.runtime.threads import one_thread
from fide_plugins.types import Float32, Float64

LEAST_SIZE = 8  # pixels of each side

OPPONENT = np.array([[0.299, 0.587, 0.114], [0.5, -0.5, 0.0], [0.25, 0.25, -0.5]], np.float32)
PAIRS = np.array([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]], np.float32)
DIRECTIONS = np.concatenate([np.eye(3, dtype=np.float32), OPPONENT, PAIRS]).T  # (3, 9)
QUANTILES = np.concatenate([[0.02], np.linspace(0.1, 0.9, 9), [0.98]])
BANDS, ORIENTATIONS, SCALES = 8, 3, 4
LEAST = 1e-3  # a contrast that no eye sees: what is below it does not differ
# Typical inverse standard deviations: of quantiles, log powers, sharpness, correlations.
SCALE_COLOR, SCALE_POWER, SCALE_SHARPNESS, SCALE_CORRELATION = 1.5, 0.15, 0.6, 0.2


_KEPT: dict[bytes, Float32] = {}  # statistics by content: loss and encoder see the same pictures
_MOST = 1024  # that are kept


def statistics(image: Float32) -> Float32:
    """Statistics (C,) of a picture (H, W, 3); C depends on its size only.

    Raises ImageError for pictures of less than 8 pixels along a side.
    """
    height, width, _ = image.shape
    if min(height, width) < LEAST_SIZE:
        raise ImageError(
            f"statistics of a texture need at least {LEAST_SIZE} pixels along each side, "
            f"got {height} x {width}"
        )
    content = hashlib.sha256(f"{height} {width} ".encode() + image.tobytes()).digest()
    found = _KEPT.get(content)
    if found is None:
        if len(_KEPT) >= _MOST:
            _KEPT.clear()
        found = _KEPT[content] = _computed(image)
    return found


def _computed(image: Float32) -> Float32:
    side = min(image.shape[:2]) // 2
    colors = image.reshape(-1, 3)
    opponent = image @ OPPONENT.T
    quantiles = np.quantile(colors @ DIRECTIONS, QUANTILES, axis=0).T.ravel()
    return np.concatenate(
        [
            SCALE_COLOR * quantiles,
            SCALE_POWER * np.log(_powers(opponent, side) + LEAST**2).ravel(),
            SCALE_SHARPNESS * _sharpness(opponent[..., 0]),
            SCALE_CORRELATION * _correlations(colors),
        ]
    ).astype(np.float32)


def _powers(opponent: Float32, side: int) -> Float64:
    """Mean power (3, bands) of the windows of that side, in bands of frequency and orientation."""
    weights = _bands(side)
    taper = _taper(side)
    total = np.zeros((3, len(weights)))
    corners = [
        (i, j) for i in _starts(opponent.shape[0], side) for j in _starts(opponent.shape[1], side)
    ]
    for i, j in corners:
        window = opponent[i : i + side, j : j + side]
        spectrum = np.fft.rfft2((window - window.mean((0, 1))) * taper, axes=(0, 1))
        total += (weights @ (np.abs(spectrum) ** 2).reshape(-1, 3)).T / side**2
    return total / len(corners)


def _starts(length: int, side: int) -> list[int]:
    """Where windows begin that overlap by half or more, the same from both ends."""
    count = max(2, -(-2 * length // side) - 1)
    first = [round(k * (length - side) / (count - 1)) for k in range((count + 1) // 2)]
    return sorted({*first, *(length - side - k for k in first)})


@lru_cache(8)
def _taper(side: int) -> Float64:
    """Hann window (side, side) of mean square 1, symmetric."""
    one = np.hanning(side + 2)[1:-1]
    taper = np.outer(one, one)
    result: Float64 = (taper / np.sqrt((taper**2).mean()))[..., None]
    return result


@lru_cache(8)
def _bands(side: int) -> Float64:
    """Weights (bands, frequencies) of means over bands, (2 sides) frequencies of `rfft2`."""
    y, x = np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None]
    radius, angle = np.hypot(y, x), np.arctan2(np.abs(y), x)
    counted = np.where((x == 0) | np.isclose(x, 0.5), 1.0, 2.0) * np.ones_like(radius)
    edges = np.geomspace(0.9 / side, 0.5, BANDS + 1)
    width = np.log(edges[1] / edges[0])
    rows = []
    for center in np.log(np.sqrt(edges[:-1] * edges[1:])):
        radial = np.clip(1 - np.abs(np.log(np.maximum(radius, 1e-9)) - center) / width, 0, 1)
        for k in range(ORIENTATIONS):
            angular = np.clip(1 - np.abs(angle - k * np.pi / 4) / (np.pi / 4), 0, 1)
            rows.append((radial * angular * counted).ravel())
    table = np.array([row for row in rows if row.sum() > 0.5])
    result: Float64 = table / table.sum(1, keepdims=True)
    return result


def _sharpness(gray: Float32) -> Float64:
    """Logarithm (2 scales,) of mean over root mean square of differences: edges have few large."""
    found = []
    for _ in range(SCALES):
        for axis in (0, 1):
            step = np.diff(gray, axis=axis).astype(np.float64)
            found.append(np.log(np.abs(step).mean() + LEAST))
            found[-1] -= 0.5 * np.log((step**2).mean() + LEAST**2)
        height, width = gray.shape
        if min(height, width) > 3:
            half = cv2.resize(gray, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
            gray = np.asarray(half, np.float32)
    return np.array(found)


def _correlations(colors: Float32) -> Float64:
    """Correlations (3,) of red, green and blue; 0 for a channel without contrast."""
    covariance = np.cov(colors.astype(np.float64), rowvar=False) + LEAST**2 * np.eye(3)
    deviation = np.sqrt(np.diag(covariance))
    result: Float64 = (covariance / np.outer(deviation, deviation))[np.triu_indices(3, 1)]
    return result


@lru_cache(8)
def _length(height: int, width: int) -> int:
    """Number of `statistics` of a picture of that size."""
    return len(statistics(np.zeros((height, width, 3), np.float32)))


class TextureEncoder(PatchEncoder):
    """Statistics of colors, frequencies and edges, without places."""

    name = "texture"
    version = "texture-1"
    uses_network = False
    threads = one_thread

    def shape(self, height: int, width: int) -> tuple[int, int]:
        """(1, C); `ImageError` below 8 pixels along a side."""
        return 1, _length(height, width)

    def _encode(self, images: torch.Tensor) -> torch.Tensor:
        with np.errstate(under="ignore"):  # squares of tiny differences
            tokens = [statistics(image) for image in images.cpu().numpy()]
        return torch.from_numpy(np.stack(tokens)[:, None]).to(images.device)
