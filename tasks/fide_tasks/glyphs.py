"""Ampersands: the glyph & of the typefaces that Matplotlib ships."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fide_tasks.base import Image

FACES = (
    "DejaVuSans",
    "cmss10",
    "STIXGeneral",
    "DejaVuSerif",
    "STIXGeneralItalic",
    "DejaVuSansMono",
    "cmr10",
    "DejaVuSans-Oblique",
)
_FILL = 0.8  # of the image that the glyph's larger side spans, relative
_SUPERSAMPLING = 4


def ampersand(size: tuple[int, int], face: int = 0) -> Image:
    """Draw an ampersand, black on white, centered: float32 (H, W, 3) in [0, 1].

    `face` counts through FACES, modulo their number.
    """
    name = FACES[face % len(FACES)]
    height, width = (side * _SUPERSAMPLING for side in size)
    sample = _ink(name, 1000)
    points = 1000 * _FILL * min(height / sample.shape[0], width / sample.shape[1])
    glyph = _ink(name, max(points, 1))[:height, :width]
    top, left = (height - glyph.shape[0]) // 2, (width - glyph.shape[1]) // 2
    canvas = np.zeros((height, width), np.uint8)
    canvas[top : top + glyph.shape[0], left : left + glyph.shape[1]] = glyph
    ink = cv2.resize(canvas, size[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.repeat(1 - ink[:, :, None] / np.float32(255), 3, axis=2)


def _ink(face: str, points: float) -> NDArray[np.uint8]:
    """Draw & alone, cut to its bounding box: 255 is full ink."""
    from PIL import Image as Picture, ImageDraw, ImageFont

    try:
        import matplotlib
    except ImportError as error:
        from fide_plugins.runtime.machine import missing

        raise missing("plot", "the fonts of the glyphs come with matplotlib") from error
    path = Path(matplotlib.get_data_path(), "fonts", "ttf", f"{face}.ttf")
    font = ImageFont.truetype(str(path), points)
    canvas = Picture.new("L", (int(2 * points) + 4, int(2 * points) + 4), 0)
    ImageDraw.Draw(canvas).text((points / 2, points / 4), "&", fill=255, font=font)
    return np.asarray(canvas.crop(canvas.getbbox()))
