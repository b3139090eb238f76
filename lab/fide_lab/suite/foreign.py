"""Problems whose target the renderer did not draw: the scenes of `image-fitting-foreign-v1`.

The error is of parameters, or of the clean render: it is 0 at the truth where that is known, and no
optimizer sees it.  `photographs/README.md` says whose the photographs are.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fide_lab.suite import renderers
from fide_plugins.space import Float, Space
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.images import as_target

_FOLDER = Path(__file__).parent
_GEOMETRY = "azimuth", "elevation", "x", "z", "radius"
_FIRST = 4000  # seed of the first target of a built-in scene

Draw = Callable[..., Any]


class Problem:
    """A task that is judged by an error, see `run.task.TaskInfo`.

    target: (H, W, 3).
    draw: function of parameters, a dictionary of a `Space` or x (dim,), and of a seed of noise,
        that gives an image (H, W, 3) or an image and its coverage (H, W).
    wrong: function of the parameters, the error.
    space: the parameters, or their number.
    truth: (dim,), where it is known.
    light: what of the light differs, "none", "exposure" or "shading".
    """

    def __init__(
        self, target: NDArray[Any], draw: Draw, wrong: Callable[[Any], float], space: Space | int,
        *, truth: Float64 | None = None, light: str = "none",
    ) -> None:  # fmt: skip
        self.name, self.seed = "foreign", 0
        self.target, self.truth, self.light = np.asarray(target, np.float32), truth, light
        self.search_space = space if isinstance(space, Space) else None
        self.dim = space.dim if isinstance(space, Space) else space
        self.draw, self._wrong = draw, wrong

    def decode(self, x: Float64) -> Any:
        """What is drawn for a point (dim,)."""
        return x.copy() if self.search_space is None else self.search_space.decode(x)

    def render(self, X: Float64, seed: Sequence[int] | None = None) -> list[Any]:
        """Images of candidates (n, dim), or pairs of an image and its coverage."""
        seeds = [0] * len(X) if seed is None else seed
        return [self.draw(self.decode(x), s) for x, s in zip(X, seeds, strict=True)]

    def error(self, x: Float64) -> float:
        """How wrong a point (dim,) is."""
        return float(self._wrong(self.decode(np.asarray(x, np.float64))))


@lru_cache(maxsize=4)
def make(scene: str, number: int) -> Problem:
    """Problem `number` of a scene; ImportError or RuntimeError where its renderer is missing."""
    problem = SCENES[scene](number)
    problem.name, problem.seed = scene, number
    return problem


def _gray(image: Any) -> Float32:
    """An image (H, W, 3) of one channel (H, W), in [0, 1]."""
    return np.repeat(np.asarray(image, np.float32)[..., None], 3, axis=2)


def _space(ranges: Mapping[str, tuple[float, float]], periodic: str = "") -> Space:
    return Space(**{k: Float(*r, periodic=k == periodic) for k, r in ranges.items()})


def _share(p: Mapping[str, Any], truth: Mapping[str, Any], ranges: Mapping[str, Any]) -> float:
    """Largest difference of two sets of parameters, in shares of their ranges."""
    return max(float(abs(p[k] - truth[k]) / (high - low)) for k, (low, high) in ranges.items())


@cache
def _photograph(name: str) -> NDArray[np.uint8]:
    """(H, W, 3) or (H, W), red first."""
    return np.asarray(Image.open(_FOLDER / "photographs" / f"{name}.png"))


# -- photographs -----------------------------------------------------------------------------------

BOARD = {"rx": (-0.9, 0.9), "ry": (-0.9, 0.9), "rz": (-np.pi, np.pi), "cx": (80, 560),
          "cy": (60, 420), "dist": (8, 26), "f": (450, 650), "k1": (-0.4, 0), "ink": (0, 0.4),
          "paper": (0.5, 1), "bg": (0.1, 0.8)}  # fmt: skip
_NEAR = 0.1  # of each range: the box of a problem that begins some 15 pixels off


@cache
def _boards() -> list[dict[str, Any]]:
    """Corners (54, 2) in pixels of 640 x 480, and the pose that OpenCV's calibration finds."""
    found: list[dict[str, Any]] = json.loads((_FOLDER / "photographs/boards.json").read_text())
    return found


def _board(number: int, near: bool) -> Problem:
    """A chessboard, from its photograph: pose, focal length, distortion and three grays."""
    board, ranges = _boards()[number], dict(BOARD)
    target = _gray(_photograph("boards")[120 * number : 120 * (number + 1)] / np.float32(255))
    if near:
        rng = np.random.default_rng(number)
        for name, at in board["pose"].items():
            low, high = BOARD[name]
            width = _NEAR * (high - low)
            start = at - rng.uniform(0.25, 0.75) * width
            ranges[name] = (start, start + width)
    corners = np.array(board["corners"])

    def wrong(p: Mapping[str, float]) -> float:
        seen = renderers.board_corners(p)
        apart = (np.linalg.norm(one - corners, axis=1).mean() for one in (seen, seen[::-1]))
        return float(min(apart))  # the pattern looks the same after half a turn

    def draw(p: Mapping[str, float], seed: int = 0) -> tuple[Float32, Float32]:
        image, cover = renderers.board(p)
        return _gray(image), cover

    space = _space(ranges, periodic="" if near else "rz")
    pose = {**board["pose"], "ink": 0.1, "paper": 0.7, "bg": 0.4}
    return Problem(target, draw, wrong, space, truth=space.encode(pose), light="exposure")


_HOMOGRAPHY = np.array(
    [[7.6285898e-01, -2.9922929e-01, 2.2567123e02], [3.3443473e-01, 1.0143901, -7.6999973e01],
     [3.4663091e-04, -1.4364524e-05, 1]]
)  # fmt: skip
"""From the first photograph of the wall to the other one, 800 x 640, published with them."""


def _wall(number: int) -> Problem:
    """A photograph of a painted wall, warped to another one: where its four corners lie."""
    first, target = (_photograph(name) / np.float32(255) for name in ("graf1", "graf3"))
    reach, H = 0.55, _HOMOGRAPHY
    if number == 1:  # the other way round
        first, target, reach, H = target, first, 0.95, np.linalg.inv(H)
    height, width = target.shape[:2]
    box = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    scale = np.diag([width / 800, height / 640, 1])
    true = cv2.perspectiveTransform(box[None], scale @ H @ np.linalg.inv(scale))[0]
    side = 2 * reach * np.array([width, height])

    def corners(x: Float64) -> Float32:
        return np.asarray(box + (x.reshape(4, 2) - 0.5) * side, np.float32)

    def draw(x: Float64, seed: int = 0) -> tuple[Float32, Float32]:
        M, size = cv2.getPerspectiveTransform(box, corners(x)), (width, height)
        image = cv2.warpPerspective(first, M, size, borderValue=(0.45, 0.45, 0.45))
        cover = cv2.warpPerspective(np.ones((height, width), np.float32), M, size)
        return np.clip(image, 0, 1), np.clip(cover, 0, 1)

    def wrong(x: Float64) -> float:
        return float(np.linalg.norm(corners(x) - true, axis=1).mean())

    truth = np.asarray((true - box) / side + 0.5, np.float64).ravel()
    return Problem(target, draw, wrong, 8, truth=truth, light="exposure")


_COINS = (  # center and mean radius in pixels: ellipses fitted to a segmentation, half a pixel out
    (334.9, 43.5, 29.0), (155.2, 51.2, 23.1), (215.4, 51.3, 22.8), (44.1, 54.5, 21.1),
    (276.1, 52.5, 19.9), (100.4, 56.3, 19.1), (270.8, 119.2, 24.9), (44.6, 124.4, 21.0),
    (205.3, 124.0, 20.1), (336.4, 124.2, 19.9), (212.5, 193.0, 23.8), (273.9, 193.7, 22.5),
)  # fmt: skip
_COIN = {"x": (20, 60), "y": (20, 60), "radius": (10, 38), "flat": (0.7, 1), "turn": (0, np.pi),
         "coin": (0.2, 0.9), "right": (-0.3, 0.3), "down": (-0.3, 0.3),
         "ground": (0, 0.6)}  # fmt: skip


def _coin(number: int) -> Problem:
    """A coin, from its photograph, as a flat disk: ellipse, gray with a slope, and the ground."""
    cx, cy, radius = _COINS[number]
    shift = np.random.default_rng(number).uniform(-8, 8, 2)
    corner = np.clip(np.array([cx, cy]) - 40 + shift, 0, [384 - 80, 303 - 80])
    left, top = corner.round().astype(int)
    target = _gray(_photograph("coins")[top : top + 80, left : left + 80] / np.float32(255))
    x, y = cx - left, cy - top

    def draw(p: Mapping[str, float], seed: int = 0) -> Float32:
        return _gray(renderers.disk(p))

    def wrong(p: Mapping[str, float]) -> float:
        return max(float(np.hypot(p["x"] - x, p["y"] - y)), abs(p["radius"] - radius))

    space = _space(_COIN, periodic="turn")
    known = {"x": x, "y": y, "radius": radius, "flat": 0.95, "turn": 0.0, "coin": 0.6,
             "right": 0.0, "down": 0.0, "ground": 0.2}  # fmt: skip
    return Problem(target, draw, wrong, space, truth=space.encode(known), light="exposure")


# -- gaps: the scene's own picture, as somebody else would take it ---------------------------------

GAPS = "exposure", "shading", "occluder", "camera"


def changed(image: NDArray[Any], gap: str, rng: np.random.Generator) -> Float32:
    """The picture (H, W, 3) of the same scene with another exposure, and so on; "clean": itself."""
    y = image.astype(np.float64)
    height, width = y.shape[:2]
    if gap == "exposure":
        y = 0.9 * (0.85 * y) ** 1.35 + 0.04
    elif gap == "shading":
        field = cv2.resize(rng.uniform(0.65, 1.3, (3, 3)), (width, height), interpolation=2)
        y = y * np.asarray(field)[..., None]
    elif gap == "occluder":
        tall, wide = int(0.3 * height), int(0.25 * width)
        top, left = rng.integers(0, height - tall), rng.integers(0, width - wide)
        patch = cv2.resize(rng.uniform(0, 1, (6, 6, 3)), (wide, tall))
        y[top : top + tall, left : left + wide] = patch
    elif gap == "camera":
        y = np.asarray(cv2.GaussianBlur(y, (0, 0), 1.44 * height / 112))
        y = np.clip(y + rng.normal(0, 0.03, y.shape), 0, 1)
        file = io.BytesIO()
        Image.fromarray((y * 255).round().astype(np.uint8)).save(file, "JPEG", quality=50)
        y = np.asarray(Image.open(file)) / 255
    return np.clip(y, 0, 1).astype(np.float32)


def clean_error(task: Any) -> Callable[[Float64], float]:
    """Mean squared error of the clean render at x (dim,), over the median of 60 random renders."""

    @cache
    def random() -> float:
        x = np.random.default_rng(5).uniform(0, 1, (60, task.dim))
        return float(np.median(((task.render(x) - task.target) ** 2).mean((1, 2, 3))))

    def error(x: Float64) -> float:
        return float(((task.render(x[None])[0] - task.target) ** 2).mean() / random())

    return error


def _gap(gap: str, clean: NDArray[Any], seed: int, *problem: Any, truth: Float64) -> Problem:
    """A problem whose picture (H, W, 3) is changed."""
    picture = changed(clean, gap, np.random.default_rng(7 * seed + 1))
    light = gap if gap in ("exposure", "shading") else "none"
    return Problem(picture, *problem, truth=truth, light=light)


def _of_task(task: Any, gap: str, wrong: Callable[[Any], float]) -> Problem:
    def draw(x: Float64, seed: int = 0) -> Any:
        return task.render(x[None], [seed])[0]

    return _gap(gap, task.target, task.seed, draw, wrong, task.dim, truth=task.x_star)


def _pose(number: int, name: str, gap: str) -> Problem:
    """A pose of `robot` or `arm`; error: `clean_error`."""
    import fide_tasks

    task = fide_tasks.make(name, size=64, seed=_FIRST + number)
    return _of_task(task, gap, clean_error(task))


def _courtyard(number: int, gap: str) -> Problem:
    """Camera and lamp in the courtyard of `san_miguel`, 48 pixels."""
    import fide_tasks

    task = fide_tasks.make("san_miguel", size=48, seed=_FIRST + number, spp=8)
    true = task.x_star
    assert true is not None

    def wrong(x: Float64) -> float:
        apart = np.abs(x - true)[:5]
        apart[4] = min(apart[4], 1 - apart[4])  # all around
        return float(apart.max())

    return _of_task(task, gap, wrong)


def _povray(number: int, gap: str) -> Problem:
    """The scene `povray` of `image-fitting-v1`, which needs the program."""
    from fide_lab.suite.definition import read
    from fide_plugins.renderers import CommandRenderer

    options = read("image-fitting-v1").scenes["povray"].options
    space = Space.read(options["space"])
    program = CommandRenderer(options["command"], space)
    truth = space.snap(np.random.default_rng((_FIRST + number, space.dim)).random(space.dim))
    true = space.decode(truth)
    ranges = {"azimuth": (-60, 60), "elevation": (5, 50), "x": (-1.5, 1.5), "z": (-2, 1),
              "radius": (0.3, 1)}  # fmt: skip

    def wrong(p: dict[str, Any]) -> float:
        if any(p[k] != true[k] for k in ("floor", "columns")):
            return 1.0
        return _share({**p, **p["ball"]}, {**true, **true["ball"]}, ranges)

    def draw(p: dict[str, Any], seed: int = 0) -> Any:
        return program(p)

    return _gap(gap, as_target(program(true)), _FIRST + number, draw, wrong, space, truth=truth)


# -- another renderer's picture of the same scene --------------------------------------------------

_BALL = {"azimuth": (-60, 60), "elevation": (8, 50), "x": (-1.5, 1.5), "z": (-1, 1),
         "radius": (0.3, 1), "sun": (-180, 180), "height": (20, 80), "red": (0, 1),
         "green": (0, 1)}  # fmt: skip


def _ball(number: int, by: str) -> Problem:
    """A ball on a checkered floor, by POV-Ray or Mitsuba; error: of camera and ball, in shares."""
    space = _space(_BALL, periodic="sun")
    x = np.random.default_rng((number, 9)).uniform(0.15, 0.85, space.dim)
    true = space.decode(x)
    target = {"povray": renderers.ball_by_povray, "mitsuba": renderers.ball_by_mitsuba}[by](true)

    def draw(p: Mapping[str, float], seed: int = 0) -> Float32:
        return renderers.ball(p)

    ranges = {k: _BALL[k] for k in _GEOMETRY}
    return Problem(
        target, draw, lambda p: _share(p, true, ranges), space, truth=x, light="exposure"
    )


def _silhouette(number: int) -> Problem:
    """A pose of `robot`, drawn by MuJoCo, by a model of eight plain capsules."""
    import fide_tasks
    from fide_tasks import panda

    task = fide_tasks.make("robot", size=64, seed=_FIRST + 100 + number)
    assert task.x_star is not None
    low, high = np.array(panda.LIMITS).T

    def joints(x: Float64) -> Float64:
        return panda.frames(low + x * (high - low))[:, :3, 3]

    true = joints(task.x_star)

    def draw(x: Float64, seed: int = 0) -> tuple[Float32, Float32]:
        return renderers.capsules(joints(x))

    def wrong(x: Float64) -> float:
        return float(np.linalg.norm(joints(x) - true, axis=1).mean())

    return Problem(task.target, draw, wrong, panda.JOINTS, truth=task.x_star, light="exposure")


# -- textures and thin lines -----------------------------------------------------------------------


def _texture(number: int) -> Problem:
    """Scale, contrast and colors of a noise whose realization is another one."""
    x = np.random.default_rng(900 + number).uniform(0.15, 0.85, renderers.TEXTURE_DIM)
    true = renderers.texture_values(x)

    def colors(p: Float64) -> Float64:
        return np.array(sorted([tuple(p[5:8]), tuple(p[8:11])], key=sum))

    def wrong(x: Float64) -> float:
        p = renderers.texture_values(x)
        apart = abs(p[0] - true[0]), np.abs(colors(p) - colors(true)).mean()
        return float(max(apart[0] / 0.1, apart[1] / 0.03))

    def draw(x: Float64, seed: int = 0) -> Float32:
        return renderers.texture(x, table=0)

    target = renderers.texture(x, table=1 + number)
    return Problem(target, draw, wrong, renderers.TEXTURE_DIM, truth=x)


_RINGS = {"dist": (0.13, 0.3), "poni1": (0.04, 0.14), "poni2": (0.01, 0.11), "rot1": (-0.2, 0.2),
          "rot2": (-0.2, 0.2), "scale": (0.2, 1), "back": (0, 0.3)}  # fmt: skip


def _rings(number: int) -> Problem:
    """Thin powder rings on a tilted detector, with noise of counting and a beam stop."""
    space = _space(_RINGS)
    rng = np.random.default_rng((number, 7))
    x = rng.uniform(0.25, 0.75, space.dim)
    true = space.decode(x)
    picture = np.clip(rng.poisson(64000 * renderers.rings(true)) / 64000, 0, 1)
    picture[renderers.beam_stop(true)] = 0
    ranges = {k: _RINGS[k] for k in ("dist", "poni1", "poni2", "rot1", "rot2")}

    def draw(p: Mapping[str, float], seed: int = 0) -> Float32:
        return _gray(renderers.rings(p))

    return Problem(_gray(picture), draw, lambda p: _share(p, true, ranges), space, truth=x)


SCENES: dict[str, Callable[[int], Problem]] = {
    "board": partial(_board, near=False),
    "board_near": partial(_board, near=True),
    "wall": _wall,
    "coin": _coin,
    **{f"robot_{gap}": partial(_pose, name="robot", gap=gap) for gap in GAPS},
    **{f"arm_{gap}": partial(_pose, name="arm", gap=gap) for gap in GAPS},
    **{f"povray_{gap}": partial(_povray, gap=gap) for gap in GAPS},
    **{f"courtyard_{gap}": partial(_courtyard, gap=gap) for gap in GAPS},
    "ball_povray": partial(_ball, by="povray"),
    "ball_mitsuba": partial(_ball, by="mitsuba"),
    "silhouette": _silhouette,
    "texture": _texture,
    "rings": _rings,
}
"""Scenes by name: a function of the number of a problem."""
