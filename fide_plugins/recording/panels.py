"""Pictures as files and figures show them; `fide_lab.figures` draws these."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np

from fide_plugins.types import Float32

THUMBNAIL = 160
"""Longer side of a thumbnail, pixels."""

GAIN = 4
"""By how much a picture of a difference is stronger than the difference."""


def as_png(image: Float32) -> bytes:
    """PNG of an image (H, W, 3) in [0, 1]."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.rint(image * 255.0).astype(np.uint8)).save(buffer, format="PNG")
    return buffer.getvalue()


def thumbnail(image: Float32, side: int = THUMBNAIL) -> Float32:
    """The image (H, W, 3), reduced if its longer side has more than `side` pixels."""
    from fide_plugins.runtime.opencv import cv2

    height, width = image.shape[:2]
    scale = side / max(height, width)
    if scale >= 1.0:
        return image
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)


@dataclass(frozen=True, eq=False)
class Panel:
    """A picture (H, W, 3) in [0, 1] of a figure, with its name and a note."""

    name: str
    image: Float32
    note: str = ""


def difference(target: Float32, image: Float32, counts: Float32 | None = None) -> Float32:
    """Difference of two pictures (H, W, 3), `GAIN` times as strong, where `counts` is not 0."""
    apart: Float32 = np.clip(GAIN * np.abs(target - image), 0, 1).astype(np.float32)
    if counts is not None:
        apart[np.asarray(counts) == 0] = 0
    return apart
