"""Spline: one stroke along a quadratic B-spline, black on white (paper, Sec. 4.2 and S1).

Notation: m control points P [m, 2] in pixels as (x, y); thickness t in pixels; the curve is
sampled as C = B P with the basis functions B [s, m], its tangents are D = B' P.

The stroke is everything within t / 2 of the curve: the segments that cross the curve at right
angles, t long, and a disc at either end. OpenCV fills it with anti-aliased quadrilaterals between
neighboring segments. Its own thick polylines would not do: their width is a whole and odd number of
pixels, so the image would not vary continuously with t.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fide_tasks.base import Image, Parameter, Task, Vector, one_of, whole_number
from fide_tasks.picture_start import stroke_of

_DEGREE = 2
_SPAN_SAMPLES = 8  # intervals on each polynomial piece of the curve, at 224 pixels
_MIN_SAMPLES = 32  # intervals on a curve, however few its pieces
_FRACTION_BITS = 8  # of OpenCV's fixed-point coordinates
_BLEED = 1.3  # px by which OpenCV's anti-aliasing widens a filled shape
_MIN_WIDTH = 2.0  # px; thinner strokes fade instead of thinning
_CORNER = 0.4  # px by which a quadrilateral may cut the outside of a bend before a disc fills it


class Spline(Task):
    """A stroke of even thickness along an open B-spline from the first control point to the last.

    Options
    -------
    control_points: number m of control points, at least 2 (then a straight line); by default 7.
    target: "ampersand", the glyph & (the default); "random", a stroke of this task's own, so that
        x_star is known; or a picture of the user's own, float (H, W, 3) in [0, 1].

    The 2 m + 1 parameters are x and y of each control point, 0 and 1 being the edges of the image,
    then the thickness, from 0 to the shorter side of the image. Below 2 pixels the stroke keeps its
    width and fades in proportion, so that the image stays continuous down to blank at 0.

    One frame takes 0.2 ms at 224 x 224 for thin strokes and up to 0.45 ms for thick ones.

    `seed` chooses the typeface of the ampersand among eight (seed modulo 8; seed 0 is DejaVu Sans),
    or the random stroke, which depends on the seed and m, not on the size.
    """

    name = "spline"

    def __init__(
        self,
        size: int | tuple[int, int] = 224,
        seed: int = 0,
        *,
        control_points: int = 7,
        target: str | ArrayLike = "ampersand",
    ) -> None:
        self.control_points = whole_number("control_points", control_points, minimum=2)
        drawn = isinstance(target, str)
        self._subject = one_of("target", target, ("ampersand", "random")) if drawn else "picture"
        super().__init__(size, seed, target=None if drawn else target)
        height, width = self.size
        self.parameters = (
            *(
                Parameter(f"point {i + 1}", name, "px", 0.0, float(high))
                for i in range(self.control_points)
                for name, high in (("x", width), ("y", height))
            ),
            Parameter("stroke", "thickness", "px", 0.0, float(min(height, width))),
        )
        self._basis, self._slope = _basis(self.control_points, max(height, width))

    def start(self) -> Vector | None:
        """Return a stroke through the dark pixels of the target; None if there are none."""
        return stroke_of(self._target, self.control_points)

    def _render(self, values: Vector, out: Image, seeds: NDArray[np.uint32]) -> None:
        for v, frame in zip(values, out, strict=True):
            P, t = v[:-1].reshape(-1, 2), float(v[-1])
            ink = _stroke(self._basis @ P, self._slope @ P, max(t, _MIN_WIDTH), self.size)
            opacity = min(t / _MIN_WIDTH, 1.0)
            gray = 1 - np.multiply(ink, opacity / 255, dtype=np.float32)
            cv2.merge([gray, gray, gray], frame)

    def _make_x_star(self) -> Vector | None:
        if self._subject != "random":
            return None
        rng = np.random.default_rng((self.seed, self.control_points))
        basis, _ = _basis(self.control_points, 1)
        while True:
            P = rng.uniform(0.1, 0.9, (self.control_points, 2))
            steps = np.diff(basis @ P, axis=0)
            if np.hypot(steps[:, 0], steps[:, 1]).sum() >= 0.5:  # sides of the image
                return np.append(P, rng.uniform(0.02, 0.08))

    def _make_target(self) -> Image:
        if self._subject == "random":
            return super()._make_target()
        return ampersand(self.size, self.seed)


def _basis(m: int, pixels: int) -> tuple[Vector, Vector]:
    """Return the B-spline basis and its derivative at samples along the curve, each (s, m)."""
    from scipy.interpolate import BSpline

    degree = min(_DEGREE, m - 1)
    spans = m - degree
    per_span = math.ceil(
        max(_SPAN_SAMPLES, _MIN_SAMPLES / spans) * math.sqrt(max(pixels, 112) / 224)
    )
    knots = np.concatenate([np.zeros(degree), np.arange(spans + 1), np.full(degree, spans)])
    curve = BSpline(knots.astype(np.float64), np.eye(m), degree)
    u = np.linspace(0, spans, spans * per_span + 1)
    return np.asarray(curve(u), np.float64), np.asarray(curve.derivative()(u), np.float64)


def _stroke(C: Vector, D: Vector, t: float, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Draw the stroke of width t >= 2 px along C with tangents D, each (s, 2); 255 is full ink."""
    ink = np.zeros(size, np.uint8)
    length = np.hypot(D[:, 0], D[:, 1])[:, None]
    T = np.divide(D, length, out=np.zeros_like(D), where=length > 1e-9)
    N = T[:, ::-1] * (-1.0, 1.0)
    left, right = C + N * ((t - _BLEED) / 2), C - N * ((t - _BLEED) / 2)
    quads = _fixed_point(np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1))
    for quad, crossed in zip(quads, _crossed(left, right, T), strict=True):
        if crossed:  # a bend tighter than t / 2
            cv2.fillPoly(ink, [quad], 255, cv2.LINE_AA, _FRACTION_BITS)
        else:
            cv2.fillConvexPoly(ink, quad, 255, cv2.LINE_AA, _FRACTION_BITS)
    radius = round((t - _BLEED) / 2 * 2**_FRACTION_BITS)
    for center in dict.fromkeys(map(tuple, _fixed_point(C)[_round_ends(T, t)].tolist())):
        cv2.circle(ink, center, radius, 255, cv2.FILLED, cv2.LINE_AA, _FRACTION_BITS)
    return ink


def _crossed(left: Vector, right: Vector, T: Vector) -> list[bool]:
    """Whether neighboring cross-segments intersect: one side of the stroke runs backwards."""
    along = T[:-1] + T[1:]
    forward = [np.einsum("ij,ij->i", np.diff(side, axis=0), along) for side in (left, right)]
    crossed: list[bool] = (np.minimum(*forward) <= 0).tolist()
    return crossed


def _round_ends(T: Vector, t: float) -> NDArray[np.bool_]:
    """Which samples get a disc: both ends, and bends whose outside the quadrilaterals would cut."""
    bend = t / 8 * (1 - np.einsum("ij,ij->i", T[:-1], T[1:])) > _CORNER
    ends = np.ones(len(T), np.bool_)
    ends[1:-1] = bend[:-1] | bend[1:]
    return ends


def _fixed_point(points: Vector) -> NDArray[np.int32]:
    """Convert pixel coordinates to OpenCV's: fixed-point, pixel centers at whole numbers."""
    fixed: NDArray[np.int32] = np.rint((points - 0.5) * 2**_FRACTION_BITS).astype(np.int32)
    return fixed


# -- ampersands: the glyph & of the typefaces that Matplotlib ships --------------------------------


FACES = (
    "DejaVuSans", "cmss10", "STIXGeneral", "DejaVuSerif", "STIXGeneralItalic", "DejaVuSansMono",
    "cmr10", "DejaVuSans-Oblique",
)  # fmt: skip
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
