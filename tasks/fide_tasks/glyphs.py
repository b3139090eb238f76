"""Ampersands: the glyph & of the typefaces that Matplotlib ships."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

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
    import matplotlib
    from PIL import Image as Picture, ImageDraw, ImageFont

    path = Path(matplotlib.get_data_path(), "fonts", "ttf", f"{FACES[face % len(FACES)]}.ttf")
    height, width = (side * _SUPERSAMPLING for side in size)
    left, top, right, bottom = ImageFont.truetype(str(path), 1000).getbbox("&")
    points = 1000 * _FILL * min(width / (right - left), height / (bottom - top))
    font = ImageFont.truetype(str(path), max(points, 1.0))
    left, top, right, bottom = font.getbbox("&")
    canvas = Picture.new("L", (width, height), 255)
    corner = (width - left - right) / 2, (height - top - bottom) / 2
    ImageDraw.Draw(canvas).text(corner, "&", fill=0, font=font)
    gray = cv2.resize(np.asarray(canvas), size[::-1], interpolation=cv2.INTER_AREA)
    return np.repeat(gray[:, :, None].astype(np.float32) / np.float32(255), 3, axis=2)
