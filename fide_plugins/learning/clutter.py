"""Clutter: renders are pasted onto other pictures while they are learned, as photographs have them.

A renderer draws an object; a photograph has a room behind it, other things in front, and its own
light.  Backgrounds are the user's pictures, or generated ones.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fide_plugins.errors import OptionError
from fide_plugins.learning.augmentation import (
    change_some,
    check_installed,
    in_front,
    middles,
    noisy,
    out_of_focus,
    uniform,
)
from fide_plugins.learning.renders import Pixels, resized
from fide_plugins.runtime.opencv import cv2
from fide_plugins.types import Float32, Indices
from fide_plugins.validation.images import as_target, load

GENERATED = "generated"
_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
_LONGEST = 512  # pixels of a background: more shows nothing at the size that is learned
_MOST_PICTURES = 2000
_NUMBER, _SIDE = 128, 128  # generated pictures, and pixels along each side
_SMALLEST_CROP = 0.3  # of the largest that fits
_CONTRAST, _LIGHT = (0.4, 1.2), 0.2  # of a background
_WIDEST_RIM = 0.06  # of the longer side
_SHADOW, _SHADOW_SHIFT = 0.5, 0.06  # at its darkest; of the longer side
_GAMMA, _GAIN = 0.6, 0.4  # powers of 2
_WHITE, _SHADING, _OFFSET = 0.08, 0.3, 0.1
_FOCUS = 0.3, 1.0  # standard deviation of a blur of 5 x 5 pixels, in pixels
_NOISE = 0.04  # standard deviation of noise, at most
_QUALITY = 30, 95  # of JPEG
_CHUNK = 100  # images that are composed at once


@dataclass(frozen=True)
class Clutter:
    """What is put behind renders, around them and in front of them.

    A store keeps each render with its coverage, and every pass of a training composes it again:

    1. background   a crop of another picture, mirrored, of another contrast, with rectangles on it
    2. rim          in half of the images another gray around the object: paper, an edge
    3. shadow       beside the object, in a quarter
    4. in front     up to two rectangles
    5. light        gain, offset, gamma and white, and a gain that is a plane over the picture
    6. camera       blur, noise and JPEG

    So the same renders serve many passes, and what only clutter decides is marginalized.  Renders
    without a coverage get what needs none: 4, 5 and 6.

    backgrounds: pictures (H, W, 3) float32 in [0, 1]; none: renders have no coverage.
    name: what they are, for a report.
    changes: False: nothing but the background is changed.
    """

    backgrounds: tuple[Float32, ...]
    name: str
    changes: bool = True

    @property
    def digest(self) -> str:
        """Of all that it depends on."""
        found = hashlib.sha256(str(self.changes).encode())
        for picture in self.backgrounds:
            found.update(np.ascontiguousarray(picture).tobytes())
        return found.hexdigest()[:16]

    def composed(self, renders: Tensor, generator: torch.Generator) -> Tensor:
        """Images (B, 3, H, W) in [0, 1] of renders (B, C, H, W); same generator, same images.

        C is 3, or 4 with the coverage; colors are multiplied by it.
        generator: of the renders' device.
        """
        images = renders
        if renders.shape[1] == 4:
            coverage = renders[:, 3:]
            images = renders[:, :3] + (1 - coverage) * self._behind(coverage, generator)
        if self.changes:
            images = images.clone()
            for change, share in _CLUTTER:
                change_some(images, change, share, generator)
        return images.clamp(0.0, 1.0)

    def fixed(self, renders: Pixels, rows: Indices, seed: int) -> Pixels:
        """Images (n, H, W, 3) uint8 of some rows (n,) of renders (N, H, W, C), always the same."""
        found = np.empty((len(rows), *renders.shape[1:3], 3), np.uint8)
        generator = torch.Generator().manual_seed(seed)
        for first in range(0, len(rows), _CHUNK):
            some = torch.from_numpy(renders[rows[first : first + _CHUNK]])
            images = self.composed(some.permute(0, 3, 1, 2).float() / 255, generator)
            pixels = (255 * images).round().to(torch.uint8).permute(0, 2, 3, 1)
            found[first : first + _CHUNK] = pixels.numpy()
        return found

    def _behind(self, coverage: Tensor, generator: torch.Generator) -> Tensor:
        """Backgrounds (B, 3, H, W) of objects with this coverage (B, 1, H, W)."""
        seed = torch.randint(2**62, (), generator=generator, device=generator.device)
        rng = np.random.default_rng(int(seed))
        height, width = coverage.shape[2:]
        crops = [_crop(self.backgrounds, (height, width), rng) for _ in range(len(coverage))]
        behind = torch.from_numpy(np.array(crops)).permute(0, 3, 1, 2).contiguous()
        behind = behind.to(coverage.device)
        if self.changes:
            change_some(behind, in_front, 1 / 2, generator)
            change_some(behind, in_front, 1 / 2, generator)
            change_some(behind, _shadowed, 1 / 4, generator, coverage)
            change_some(behind, _rimmed, 1 / 2, generator, coverage)
        return behind


def _crop(pictures: Sequence[Float32], size: tuple[int, int], rng: np.random.Generator) -> Float32:
    """Part (H, W, 3) of one of the pictures, mirrored or not, of another contrast and light."""
    picture = pictures[int(rng.integers(len(pictures)))]
    largest = min(picture.shape[0] / size[0], picture.shape[1] / size[1])
    scale = largest * rng.uniform(_SMALLEST_CROP, 1.0)
    sides = [max(1, round(scale * side)) for side in size]
    top, left = (int(rng.integers(a - b + 1)) for a, b in zip(picture.shape, sides, strict=False))
    part = resized(picture[top : top + sides[0], left : left + sides[1]], size)
    part = part[:, :: int(rng.choice((-1, 1)))]
    contrast, light = rng.uniform(*_CONTRAST), rng.uniform(-_LIGHT, _LIGHT)
    changed = np.float32(contrast) * (part - 0.5) + np.float32(0.5 + light)
    return np.asarray(np.clip(changed, 0.0, 1.0), np.float32)


def _rimmed(behind: Tensor, coverage: Tensor, generator: torch.Generator) -> Tensor:
    """With one gray around the object."""
    n, _, height, width = behind.shape
    gray = uniform(n, 1, 0.0, 1.0, generator)[:, :, None, None]
    most = max(1, round(_WIDEST_RIM * max(height, width)))
    rims = torch.randint(1, most + 1, (n,), generator=generator, device=generator.device).tolist()
    masks = coverage[:, 0].cpu().numpy()
    wider = [
        cv2.dilate(mask, np.ones((2 * rim + 1,) * 2, np.uint8))
        for mask, rim in zip(masks, rims, strict=True)
    ]
    around = torch.from_numpy(np.array(wider))[:, None].to(behind.device)
    return around * gray + (1 - around) * behind


def _shadowed(behind: Tensor, coverage: Tensor, generator: torch.Generator) -> Tensor:
    """Darker beside the object."""
    from kornia.filters import gaussian_blur2d
    from kornia.geometry import translate

    n, _, height, width = behind.shape
    side = max(height, width)
    shift = uniform(n, 2, -_SHADOW_SHIFT * side, _SHADOW_SHIFT * side, generator)
    soft = gaussian_blur2d(translate(coverage, shift), 5, (1.5, 1.5), border_type="replicate")
    dark = uniform(n, 1, 0.0, _SHADOW, generator)[:, :, None, None]
    shadowed: Tensor = behind * (1 - dark * soft)
    return shadowed


def _lit(images: Tensor, generator: torch.Generator) -> Tensor:
    """In another light: gamma, gain, a gain that is a plane over the picture, white, offset."""
    n, _, height, width = images.shape
    gamma = torch.exp2(uniform(n, 1, -_GAMMA, _GAMMA, generator))
    gain = torch.exp2(uniform(n, 1, -_GAIN, _GAIN, generator))
    white = 1 + uniform(n, 3, -_WHITE, _WHITE, generator)
    slopes = uniform(n, 2, -_SHADING, _SHADING, generator)[:, :, None, None]
    offset = uniform(n, 1, -_OFFSET, _OFFSET, generator)
    y = 2 * middles(height, images.device)[:, None] - 1
    x = 2 * middles(width, images.device)[None, :] - 1
    plane = 1 + slopes[:, :1] * y + slopes[:, 1:] * x  # (n, 1, H, W)
    bent = images.clamp(0.0, 1.0) ** gamma[:, :, None, None]
    return plane * bent * (gain * white)[:, :, None, None] + offset[:, :, None, None]


def _out_of_focus(images: Tensor, generator: torch.Generator) -> Tensor:
    return out_of_focus(images, generator, _FOCUS, 5)


def _noised(images: Tensor, generator: torch.Generator) -> Tensor:
    return noisy(images, generator, _NOISE)


def _compressed(images: Tensor, generator: torch.Generator) -> Tensor:
    """As JPEG has them."""
    qualities = uniform(len(images), 1, *_QUALITY, generator)[:, 0].tolist()
    pixels = (255 * images.clamp(0.0, 1.0)).byte().permute(0, 2, 3, 1).cpu().numpy()
    found = []
    for image, quality in zip(pixels, qualities, strict=True):
        _, file = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(quality)])
        found.append(cv2.imdecode(file, cv2.IMREAD_COLOR))
    whole = torch.from_numpy(np.array(found)).to(images.device)
    return whole.permute(0, 3, 1, 2).float() / 255


_CLUTTER = (
    (in_front, 1 / 4), (in_front, 1 / 4), (_lit, 3 / 4), (_out_of_focus, 1 / 2), (_noised, 1 / 2),
    (_compressed, 1 / 4),
)  # fmt: skip


def clutter_of(backgrounds: Any, clutter: object, seed: int) -> Clutter | None:
    """What `learn` composes renders with, see its arguments; None: nothing.

    Raises OptionError, also for a folder without pictures, and ImageError for a file that is none.
    """
    if not (clutter is None or isinstance(clutter, bool)):
        raise OptionError(f"clutter is True, False or None, not {clutter!r}")
    if backgrounds is None and not clutter:
        return None
    changes = clutter is not False
    check_installed("photograph" if changes else "none")
    if backgrounds is None or (isinstance(backgrounds, str) and backgrounds == GENERATED):
        return Clutter(tuple(generated(_NUMBER, _SIDE, seed)), "generated backgrounds", changes)
    pictures = _pictures(backgrounds)
    what = "1 background" if len(pictures) == 1 else f"{len(pictures)} backgrounds"
    return Clutter(tuple(pictures), what, changes)


def _pictures(backgrounds: Any) -> list[Float32]:
    """Pictures of a folder or a list, of moderate size."""
    if isinstance(backgrounds, str | os.PathLike):
        folder = Path(backgrounds)
        if not folder.is_dir():
            raise OptionError(
                f"backgrounds must be a folder of pictures, a list of them or {GENERATED!r}; there "
                f"is no folder {os.fspath(folder)!r}"
            )
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() in _SUFFIXES)
        if not files:
            raise OptionError(
                f"the folder {os.fspath(folder)!r} has no picture ({', '.join(_SUFFIXES)}): put "
                f"some there, or take backgrounds={GENERATED!r}"
            )
        return [load(file, max_side=_LONGEST) for file in files[:_MOST_PICTURES]]
    if not isinstance(backgrounds, list | tuple) or not backgrounds:
        raise OptionError(
            f"backgrounds must be a folder of pictures, a list of them or {GENERATED!r}, not "
            f"{backgrounds!r:.60}"
        )
    found = []
    for i, one in enumerate(backgrounds):
        picture = as_target(one, what=f"backgrounds[{i}]")
        small = min(1.0, _LONGEST / max(picture.shape[:2]))
        height, width = (max(1, round(small * side)) for side in picture.shape[:2])
        found.append(resized(picture, (height, width)))
    return found


# -- generated backgrounds -------------------------------------------------------------------------


def generated(n: int, side: int, seed: int) -> list[Float32]:
    """Pictures (side, side, 3) with what natural pictures have, of five kinds in turn.

    Dead leaves (shapes that cover each other; Lee, Mumford and Huang 2001), noise of an amplitude
    that falls with frequency, gradients, straight edges, and strokes like text.
    """
    rng = np.random.default_rng((seed, 4))
    kinds = (_leaves, _clouds, _edges, _leaves, _strokes)
    found = []
    for i in range(n):
        picture = kinds[i % len(kinds)](side, rng)
        if rng.random() < 0.5:
            picture = picture + rng.uniform(0.05, 0.3) * (_clouds(side, rng) - 0.5)
        if rng.random() < 0.5:  # gray, as many photographs nearly are
            picture = np.repeat(picture.mean(axis=2, keepdims=True), 3, axis=2)
        found.append(np.clip(picture, 0.0, 1.0).astype(np.float32))
    return found


def _leaves(side: int, rng: np.random.Generator) -> Float32:
    """Disks and polygons that cover each other; radii r with a density of r^-3."""
    picture = np.empty((side, side, 3), np.float32)
    picture[:] = _color(rng)
    least, most = side / 60, side / 2.5
    for _ in range(int(rng.integers(40, 300))):
        radius = (least**-2 - rng.random() * (least**-2 - most**-2)) ** -0.5
        x, y = rng.uniform(-0.1, 1.1, 2) * side
        if rng.random() < 0.5:
            cv2.circle(picture, (int(x), int(y)), int(radius) + 1, _color(rng), -1, cv2.LINE_AA)
        else:
            turns = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 6))))
            corners = np.stack([x + radius * np.cos(turns), y + radius * np.sin(turns)], axis=1)
            cv2.fillPoly(picture, [corners.astype(np.int32)], _color(rng), cv2.LINE_AA)
    return picture


def _clouds(side: int, rng: np.random.Generator) -> Float32:
    """Noise of an amplitude that falls with frequency, as f^-1 to f^-2, mostly gray."""
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None, :])
    frequency[0, 0] = np.inf
    common = rng.standard_normal((side, side, 1))
    white = common + rng.uniform(0, 0.7) * rng.standard_normal((side, side, 3))
    spectrum = np.fft.rfft2(white, axes=(0, 1)) * (frequency ** -rng.uniform(1.0, 2.0))[..., None]
    noise = np.fft.irfft2(spectrum, (side, side), axes=(0, 1))
    noise = noise / max(float(noise.std()), 1e-9)
    return np.asarray(0.5 + rng.uniform(0.08, 0.25) * noise + rng.uniform(-0.2, 0.2), np.float32)


def _edges(side: int, rng: np.random.Generator) -> Float32:
    """Half planes and stripes on a gradient, as of walls, tables and blinds."""
    y, x = np.mgrid[0 : 1 : side * 1j, 0 : 1 : side * 1j]
    turn = rng.uniform(0, 2 * np.pi)
    ramp = (np.cos(turn) * x + np.sin(turn) * y)[..., None]
    picture = np.array(_color(rng)) + rng.uniform(0, 0.6) * (ramp - 0.5)
    for _ in range(int(rng.integers(1, 7))):
        turn, period = rng.uniform(0, 2 * np.pi), rng.uniform(0.03, 0.6)
        across = np.cos(turn) * x + np.sin(turn) * y - rng.uniform(-0.5, 1.0)
        width = rng.uniform(0.02, 0.5)
        inside = across > 0 if rng.random() < 0.4 else np.abs(across) < width
        if rng.random() < 0.25:
            inside &= np.mod(across, period) < period / 2
        picture = np.where(inside[..., None], np.array(_color(rng)), picture)
    return np.asarray(picture, np.float32)


def _strokes(side: int, rng: np.random.Generator) -> Float32:
    """Rows of short strokes, like text, on paper."""
    picture = np.asarray(0.6 * _clouds(side, rng) + 0.4 * np.array(_color(rng)), np.float32)
    for _ in range(int(rng.integers(1, 4))):
        color, height = _color(rng), rng.uniform(0.02, 0.12) * side
        left, right = np.sort(rng.uniform(0, side, 2))
        for y in np.arange(rng.uniform(0, side), side, 1.6 * height)[: int(rng.integers(1, 12))]:
            for x in np.arange(left, right, 0.6 * height):
                ends = (np.array([x, y]) + rng.uniform(0, height, (2, 2)) * (0.5, 1.0)).astype(int)
                cv2.line(picture, ends[0].tolist(), ends[1].tolist(), color, 1, cv2.LINE_AA)
    return picture


def _color(rng: np.random.Generator) -> tuple[float, float, float]:
    """A color: a gray, and some deviation from it."""
    red, green, blue = np.clip(rng.uniform(0, 1) + rng.uniform(-0.2, 0.2, 3), 0.0, 1.0).tolist()
    return red, green, blue
