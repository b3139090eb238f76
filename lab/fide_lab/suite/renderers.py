"""Small renderers of `foreign`, and other renderers' pictures of the same scenes.

Images are float32 in [0, 1], (H, W, 3) or, of one channel, (H, W).
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from fide_plugins.types import Float32, Float64

SIDE = 64
Values = Mapping[str, float]


def _smaller(image: Any, width: int, height: int) -> Float32:
    """An image of float or bool, averaged."""
    size = (width, height)
    return np.asarray(
        cv2.resize(np.asarray(image, np.float32), size, interpolation=cv2.INTER_AREA), np.float32
    )


# -- a chessboard before a camera with radial distortion -------------------------------------------

_CORNERS = np.zeros((54, 3))
_CORNERS[:, :2] = np.mgrid[0:9, 0:6].T.reshape(-1, 2)


def _board_pose(p: Values) -> tuple[Float64, Float64]:
    """Rotation (3, 3) and translation (3,) from the board to the camera, in squares."""
    turns = [cv2.Rodrigues(np.eye(3)[i] * p[k])[0] for i, k in enumerate(("rx", "ry", "rz"))]
    R = np.asarray(turns[0] @ turns[1] @ turns[2], np.float64)
    center = np.array([(p["cx"] - 320) / p["f"], (p["cy"] - 240) / p["f"], 1]) * p["dist"]
    return R, center - R @ [4, 2.5, 0]


def board(p: Values, width: int = 160) -> tuple[Float32, Float32]:
    """Image (3/4 width, width), and coverage: the board, on a plain ground."""
    R, T = _board_pose(p)
    height, pixel = 3 * width // 4, 320 / width  # of half a pixel, in those of the photograph
    v, u = (np.mgrid[0 : 2 * height, 0 : 2 * width] + 0.5) * pixel - 0.5
    seen = np.stack([u - 320, v - 240]) / p["f"]
    far = (seen**2).sum(axis=0)
    r = far
    for _ in range(3):
        bend = 1 + p["k1"] * r
        r = far / bend**2
    to_board = np.linalg.inv(np.stack([R[:, 0], R[:, 1], T], 1))
    x, y, z = np.tensordot(to_board[:, :2], seen / bend, 1) + to_board[:, 2, None, None]
    z = np.where(abs(z) < 1e-9, 1e-9, z)
    x, y = x / z, y / z
    covered = (x > -0.7) & (x < 8.62) & (y > -1.1) & (y < 6.05) & (z > 0)
    squares = (x > -0.53) & (x < 8.48) & (y > -0.95) & (y < 5.93)  # the outermost are cut
    black = squares & ((np.floor(x) + np.floor(y)) % 2 == 0)
    image = np.where(covered, np.where(black, p["ink"], p["paper"]), p["bg"])
    return _smaller(image, width, height), _smaller(covered, width, height)


def board_corners(p: Values) -> Float64:
    """Where the 54 inner corners are seen, (54, 2) in pixels of 640 x 480."""
    R, T = _board_pose(p)
    X = _CORNERS @ R.T + T
    q = X[:, :2] / X[:, 2:]
    bent: Float64 = q * (1 + p["k1"] * (q**2).sum(1, keepdims=True)) * p["f"] + [320, 240]
    return bent


# -- a flat disk -----------------------------------------------------------------------------------


def disk(p: Values) -> Float32:
    """Image (80, 80): an ellipse whose gray has a slope, on a plain ground."""
    v, u = np.mgrid[0:160, 0:160] / 2 + 0.25
    x, y = u - p["x"], v - p["y"]
    c, s, root = np.cos(p["turn"]), np.sin(p["turn"]), np.sqrt(p["flat"])
    covered = np.hypot((c * x + s * y) * root, (c * y - s * x) / root) < p["radius"]
    gray = p["coin"] + (p["right"] * x + p["down"] * y) / 40
    return _smaller(np.where(covered, np.clip(gray, 0, 1), p["ground"]), 80, 80)


# -- a ball on a checkered floor: by one ray a point, by POV-Ray, by path tracing ------------------
#
# The axes are POV-Ray's: x to the right, y up, z away.

_SKY, _AIM = (0.55, 0.7, 0.9), np.array([0, 0.6, 0])
_DISTANCE, _ANGLE = 6.0, 45.0
_AMBIENT, _DIFFUSE = 0.25, 0.75
_PROGRAM = """
#version 3.7;
global_settings {{ assumed_gamma 2.2 }}
camera {{ location <{eye}> look_at <{aim}> angle {angle} right x up y }}
light_source {{ <{sun}> rgb 1 area_light x*3, y*3, 5, 5 jitter }}
background {{ rgb <{sky}> }}
plane {{ y, 0 pigment {{ checker rgb 0.2, rgb 0.8 }}
  finish {{ ambient 0.25 diffuse 0.75 reflection 0.06 }} }}
sphere {{ <{x}, {radius}, {z}>, {radius} pigment {{ rgb <{red}, {green}, 0.25> }}
  finish {{ ambient 0.25 diffuse 0.7 specular 0.5 roughness 0.02 }} }}
"""


def _direction(around: float, up: float) -> Float64:
    """Unit vector, in degrees; around 0: before the scene."""
    a, e = np.radians([around, up])
    return np.array([-np.sin(a) * np.cos(e), np.sin(e), -np.cos(a) * np.cos(e)])


def _eye(p: Values) -> Float64:
    return _AIM + _DISTANCE * _direction(p["azimuth"], p["elevation"])


@cache
def _lens() -> Float64:
    """Directions of two by two rays a pixel in the camera: right, down, ahead, (128, 128, 3)."""
    n = 2 * SIDE
    v, u = (np.mgrid[0:n, 0:n] + 0.5) / n * 2 - 1
    half = np.tan(np.radians(_ANGLE / 2))
    rays = np.stack([half * u, half * v, np.ones_like(u)], -1)
    directions: Float64 = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return directions


def ball(p: Values) -> Float32:
    """Image (64, 64, 3): matt ball and floor, a hard shadow."""
    eye, sun = _eye(p), _direction(p["sun"], p["height"])
    ahead = (_AIM - eye) / _DISTANCE
    right = np.cross([0, 1, 0], ahead)
    right /= np.linalg.norm(right)
    rays = _lens() @ np.stack([right, np.cross(right, ahead), ahead])
    center = np.array([p["x"], p["radius"], p["z"]])
    image = np.zeros_like(rays) + _SKY
    t = -eye[1] / np.minimum(rays[..., 1], -1e-9)
    floor = rays[..., 1] < -1e-3
    place = eye + rays * t[..., None]
    tiles = (np.floor(place[..., 0]) + np.floor(place[..., 2])) % 2
    lit = ~_hits(place, sun, center, p["radius"])[0]
    light = _AMBIENT + _DIFFUSE * lit * sun[1]
    image[floor] = (np.where(tiles, 0.8, 0.2) * light)[floor][:, None]
    hit, far = _hits(eye, rays, center, p["radius"])
    normal = (eye + rays * far[..., None] - center) / p["radius"]
    shade = _AMBIENT + _DIFFUSE * np.maximum(normal @ sun, 0)
    image[hit] = shade[hit][:, None] * [p["red"], p["green"], 0.25]
    return _smaller(np.clip(image, 0, 1), SIDE, SIDE)


def _hits(start: Any, rays: Any, center: Float64, radius: float) -> tuple[Any, Any]:
    """Whether rays from some points meet a ball ahead of them, and after how far."""
    away = start - center
    b = (away * rays).sum(-1)
    root = b * b - (away * away).sum(-1) + radius**2
    far = -b - np.sqrt(np.maximum(root, 0))
    return (root > 0) & (far > 0), far


def ball_by_povray(p: Values) -> Float32:
    """The same with soft shadows, gloss and a floor that reflects; RuntimeError without POV-Ray."""
    sun = 30 * _direction(p["sun"], p["height"])
    vectors: dict[str, Any] = {"eye": _eye(p), "aim": _AIM, "sun": sun, "sky": _SKY}
    texts = {name: ", ".join(f"{x:.6f}" for x in vector) for name, vector in vectors.items()}
    program = _PROGRAM.format(angle=_ANGLE, **{**p, **texts})
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "ball.pov").write_text(program, "utf-8")
        words = f"povray ball.pov +Oball.png +W{SIDE} +H{SIDE} +A0.1 -D +WT1".split()
        try:
            subprocess.run(words, cwd=folder, check=True, capture_output=True, timeout=60)
        except (OSError, subprocess.SubprocessError) as error:
            raise RuntimeError(f"POV-Ray cannot draw the scene: {error}; install povray") from error
        with Image.open(Path(folder, "ball.png")) as image:
            return np.asarray(image.convert("RGB"), np.float32) / np.float32(255)


def ball_by_mitsuba(p: Values) -> Float32:
    """The same, path traced, with a ball of plastic; ImportError without Mitsuba."""
    from fide_tasks import mitsuba_variant

    def place(v: Any) -> list[float]:
        return [float(v[0]), float(v[1]), -float(v[2])]

    def gray(value: float) -> dict[str, Any]:
        return {"type": "rgb", "value": value}

    with mitsuba_variant.in_variant(mitsuba_variant.choose("auto")) as mi:
        T = mi.ScalarTransform4f
        floor = T().rotate([1, 0, 0], -90).scale(40)
        tiles = {"type": "checkerboard", "color0": gray(0.2), "color1": gray(0.8),
                 "to_uv": T().scale([40, 40, 1])}  # fmt: skip
        color = {"type": "rgb", "value": [p["red"], p["green"], 0.25]}
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path", "max_depth": 4},
                "sensor": {
                    "type": "perspective", "fov": _ANGLE,
                    "to_world": T().look_at(place(_eye(p)), place(_AIM), [0, 1, 0]),
                    "film": {"type": "hdrfilm", "width": SIDE, "height": SIDE,
                             "rfilter": {"type": "box"}},
                },
                "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.38, 0.5]}},
                "sun": {"type": "directional", "irradiance": gray(1.6),
                        "direction": place(-_direction(p["sun"], p["height"]))},
                "floor": {"type": "rectangle", "to_world": floor,
                          "bsdf": {"type": "diffuse", "reflectance": tiles}},
                "ball": {"type": "sphere", "center": place([p["x"], p["radius"], p["z"]]),
                         "radius": p["radius"],
                         "bsdf": {"type": "plastic", "diffuse_reflectance": color}},
            }
        )  # fmt: skip
        image = np.array(mi.render(scene, spp=256, seed=0))[..., :3]
    return np.asarray(np.clip(image, 0, 1), np.float32)


# -- a robot as capsules ---------------------------------------------------------------------------

_FINE = 4
_LINKS = (  # from joint, to joint, share of the way, radius in m, color
    (0, 1, 1.0, 0.075, (0.85, 0.84, 0.80)),
    (1, 3, 0.6, 0.065, (0.16, 0.50, 0.56)),
    (3, 1, 0.4, 0.062, (0.96, 0.84, 0.55)),
    (3, 4, 1.0, 0.058, (0.96, 0.84, 0.55)),
    (4, 5, 0.55, 0.060, (0.88, 0.42, 0.30)),
    (5, 4, 0.45, 0.055, (0.55, 0.68, 0.86)),
    (6, 7, 1.0, 0.050, (0.47, 0.36, 0.62)),
    (7, 8, 1.0, 0.045, (0.60, 0.70, 0.60)),
)


def capsules(joints: Float64) -> tuple[Float32, Float32]:
    """Image (64, 64, 3), and coverage, of plain links between joints (8, 3) in m, as `robot` sees.

    A link is drawn over those behind it.
    """
    from fide_tasks import panda

    a, e = np.radians([panda.AZIMUTH, panda.ELEVATION])
    ahead = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([np.sin(a), -np.cos(a), 0.0])
    camera = np.array(panda.LOOK_AT) - panda.DISTANCE * ahead
    tip = joints[7] + panda.HAND / panda.FLANGE * (joints[7] - joints[6])
    points = np.vstack([np.zeros(3), joints[:7], tip]) - camera
    n = _FINE * SIDE
    focal = n / 2 / np.tan(np.radians(panda.FOV / 2))
    axes = np.stack([right, np.cross(ahead, right)])
    image, cover = np.zeros((n, n, 3), np.float32), np.zeros((n, n), np.float32)
    drawn = []
    for i, j, share, radius, color in _LINKS:
        ends = np.stack([points[i], points[i] + share * (points[j] - points[i])])
        depth = ends @ ahead
        at = (n / 2 + focal * (ends @ axes.T) / depth[:, None]).round().astype(int)
        width = max(1, round(2 * focal * radius / depth.mean()))
        drawn.append((depth.mean(), at.tolist(), width, color))
    for _, (p, q), width, color in sorted(drawn, key=lambda one: -one[0]):
        cv2.line(image, p, q, color, width)
        cv2.line(cover, p, q, 1.0, width)
    return _smaller(image, SIDE, SIDE), _smaller(cover, SIDE, SIDE)


# -- a texture of gradient noise -------------------------------------------------------------------

_NAMES = "log scale", "gain", "contrast", "warp", "stretch"
TEXTURE_DIM = 13
_LOW = np.array([np.log(2), 0.2, 0.5, 0, -0.8, *[0] * 8])
_HIGH = np.array([np.log(16), 0.8, 4, 1.5, 0.8, *[1] * 6, 200, 200])


def texture_values(x: Float64) -> Float64:
    """Log scale, gain, contrast, warp, stretch, two colors, and the place in the noise, (13,)."""
    values: Float64 = _LOW + (_HIGH - _LOW) * np.clip(x, 0, 1)
    return values


@cache
def _table(seed: int) -> tuple[Any, Float64]:
    """Permutation of 256, twice, and gradients (256, 2), of a realization."""
    rng = np.random.default_rng(seed)
    order, angles = np.tile(rng.permutation(256), 2), rng.uniform(0, 2 * np.pi, 256)
    return order, np.stack([np.cos(angles), np.sin(angles)], 1)


def _noise(x: Float64, y: Float64, table: int) -> Float64:
    order, gradients = _table(table)
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = x - i, y - j
    u, v = (t**3 * (t * (t * 6 - 15) + 10) for t in (fx, fy))

    def corner(a: int, b: int) -> Float64:
        g = gradients[order[order[(i + a) & 255] + ((j + b) & 255)]]
        slope: Float64 = g[..., 0] * (fx - a) + g[..., 1] * (fy - b)
        return slope

    below = corner(0, 0) * (1 - u) + corner(1, 0) * u
    above = corner(0, 1) * (1 - u) + corner(1, 1) * u
    mixed: Float64 = below * (1 - v) + above * v
    return mixed


def texture(x: Float64, table: int) -> Float32:
    """Image (64, 64, 3) of four octaves of noise between two colors; table: the realization."""
    p = texture_values(x)
    v, u = np.mgrid[0:SIDE, 0:SIDE] / SIDE
    scale = np.exp(p[0])
    X, Y = u * scale * np.exp(p[4] / 2) + p[11], v * scale * np.exp(-p[4] / 2) + p[12]
    X, Y = (
        X + _noise(X / 2 + 31.3, Y / 2 + 7.1, table) * p[3],
        Y + _noise(X / 2 + 11.7, Y / 2 + 91.9, table) * p[3],
    )
    total = sum(p[1] ** k * _noise(X * 2**k, Y * 2**k, table) for k in range(4))
    mix = 1 / (1 + np.exp(-p[2] * 4 * total))[..., None]
    return np.asarray(p[5:8] * mix + p[8:11] * (1 - mix), np.float32)


# -- powder rings on a tilted detector -------------------------------------------------------------

_SHAPE, _PIXEL = (130, 122), 172e-6 * 8  # m
_ANGLES = np.cumsum(
    [0.085, 0.0132, 0.0301, 0.0102, 0.0252, 0.0121, 0.0201, 0.0161, 0.0133, 0.0182, 0.0115, 0.0171,
     0.0127, 0.0160, 0.0111, 0.0152, 0.0120, 0.0141, 0.0117, 0.0138, 0.0114]
)  # fmt: skip
_SHARPNESS = 1.57e-3  # rad
_Y, _X = (np.mgrid[0 : _SHAPE[0], 0 : _SHAPE[1]] + 0.5) * _PIXEL


def _scattered(p: Values) -> Float64:
    """Angle between the beam and the ray to each pixel, (130, 122)."""
    a, b, far = _Y - p["poni1"], _X - p["poni2"], p["dist"]
    c1, s1, c2, s2 = np.cos(p["rot1"]), np.sin(p["rot1"]), np.cos(p["rot2"]), np.sin(p["rot2"])
    beside = np.hypot(a * c2 + b * s1 * s2 - far * c1 * s2, b * c1 + far * s1)
    angle: Float64 = np.arctan2(beside, a * s2 - b * s1 * c2 + far * c1 * c2)
    return angle


def rings(p: Values) -> Float32:
    """Image (130, 122)."""
    q = _scattered(p)
    image = sum(
        np.exp(-0.5 * ((q - at) / _SHARPNESS) ** 2) / (1 + 0.15 * i) for i, at in enumerate(_ANGLES)
    )
    picture = np.clip(p["back"] + p["scale"] * image * np.cos(q) ** 3, 0, 1)
    return np.asarray(picture, np.float32)


def beam_stop(p: Values) -> Any:
    """Pixels (130, 122) behind it."""
    return _scattered(p) < 0.04
