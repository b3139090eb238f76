from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fide_plugins.losses import perceptual
from fide_plugins.losses.perceptual import PerceptualLoss
from fide_plugins.types import Float32


def scene(rng: np.random.Generator, size: int = 112) -> Float32:
    """Five colored disks on a colored ground."""
    rows, columns = (np.mgrid[:size, :size] + 0.5) / size
    image: NDArray[np.float64] = np.broadcast_to(rng.random(3), (size, size, 3))
    for _ in range(5):
        x, y, radius = rng.uniform((0.1, 0.1, 0.05), (0.9, 0.9, 0.3))
        image = np.where(np.hypot(columns - x, rows - y)[..., None] < radius, rng.random(3), image)
    return image.astype(np.float32)


def noisy(image: Float32, rng: np.random.Generator, spread: float = 0.15) -> Float32:
    noise = spread * rng.standard_normal(image.shape)
    return np.clip(image + noise, 0, 1).astype(np.float32)


def test_constant_colors_by_hand() -> None:
    color = np.array([0.8, 0.4, 0.2])
    luma = color @ (0.299, 0.587, 0.114)
    opponent = (luma, (color[2] - luma) / 1.772, (color[0] - luma) / 1.402)  # Rec. 601
    value = PerceptualLoss(np.zeros((20, 20, 3)))(np.broadcast_to(color, (1, 20, 20, 3)))[0]
    np.testing.assert_allclose(value, 4 * np.sum(np.square(opponent)), rtol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_noise_is_subtracted_and_the_picture_is_not(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """Noisy renders of the target lose most of what noise costs, and others stay as they are."""
    rng = np.random.default_rng(seed)
    target, image = scene(rng), scene(rng)
    found, other = ([noisy(x, rng, 0.05) for _ in range(8)] for x in (target, image))
    loss = PerceptualLoss(target)
    clean, left = loss(image[None])[0], loss(found).mean()
    assert abs(loss(other).mean() - clean) < 0.02 * clean
    monkeypatch.setattr(perceptual, "NOISE_FROM", np.inf)
    without = PerceptualLoss(target)
    np.testing.assert_allclose(clean, without(image[None])[0], rtol=0.01)
    assert left < 0.4 * without(found).mean()


def gaussians(pixels: int, samples: int, scale: float) -> NDArray[np.float64]:
    """Around the centers of equal parts, cut off at 3 standard deviations; rows sum to 1."""
    centers = (np.arange(samples) + 0.5) * (pixels / samples) - 0.5
    distance = np.arange(pixels) - centers[:, None]
    w = np.exp(-0.5 * (distance / scale) ** 2) * (np.abs(distance) <= 3 * scale)
    normalized: NDArray[np.float64] = w / w.sum(axis=1, keepdims=True)
    return normalized


def mean(x: NDArray[np.float64], down: Any, across: Any) -> NDArray[np.float64]:
    means: NDArray[np.float64] = np.einsum("ip,jq,pq...->ij...", down, across, x, optimize=True)
    return means


def steps(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Differences right and down of (a, b, 3), (a, b, 6); none beyond the border."""
    g = np.zeros((*x.shape[:2], 6))
    g[:-1, :, :3], g[:, :-1, 3:] = x[1:] - x[:-1], x[:, 1:] - x[:, :-1]
    return g


def local(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Local means of squares, summed over the last axis."""
    down, across = (gaussians(n, int(np.ceil(n / 2)), 2.0) for n in x.shape[:2])
    return mean(np.square(x).sum(axis=2), down, across)


def by_definition(image: Float32, target: Float32) -> float:
    """The module's formula, in double precision, with full matrices."""
    height, width, _ = image.shape
    unit = np.sqrt(height * width) / 56
    opponent = np.array([[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5],
                         [0.5, -0.418688, -0.081312]])  # fmt: skip
    board = (-1.0) ** np.add.outer(np.arange(height), np.arange(width))[..., None]
    h, w = int(np.ceil(height / unit)), int(np.ceil(width / unit))
    finest = [
        mean(
            x.astype(np.float64) @ opponent.T, gaussians(height, h, unit), gaussians(width, w, unit)
        )
        for x in (image, image * board, target, target * board)
    ]

    def at_least(square: Any, noise: Any) -> Any:
        return np.maximum(square - noise, square / 10)

    total = 0.0
    for level in range(4):
        spacing = unit * 2**level
        if level:
            rows, columns = int(np.ceil(height / spacing)), int(np.ceil(width / spacing))
            blur = np.sqrt(spacing**2 - unit**2)
            down = gaussians(h, rows, blur * h / height)
            across = gaussians(w, columns, blur * w / width)
        else:
            down, across = np.eye(h), np.eye(w)
        v, grain, v_target, grain_target = (mean(x, down, across) for x in finest)

        difference = local(steps(v - v_target))
        difference = at_least(difference, local(steps(grain - grain_target)))
        contrast = local(steps(v)) + local(steps(v_target))
        total += float((difference / (contrast + 0.001)).mean()) / 4
    color = np.square(v - v_target).sum(axis=2).mean()
    return total + 4 * float(at_least(color, np.square(grain - grain_target).sum(axis=2).mean()))


@pytest.mark.parametrize("size", [(96, 96), (90, 130)])
def test_the_definition(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(13)
    a, b = (noisy(scene(rng, max(size)), rng)[: size[0], : size[1]] for _ in range(2))
    np.testing.assert_allclose(PerceptualLoss(a)(b[None])[0], by_definition(b, a), rtol=1e-3)


def test_a_checkerboard_counts_as_noise() -> None:
    """The module's numbers: it hides nine tenths of a difference, noise of that strength none."""
    columns = np.arange(128) / 127
    board = (-1.0) ** np.add.outer(np.arange(128), np.arange(128))
    target = np.broadcast_to(0.3 + 0.4 * columns, board.shape)
    signs = np.random.default_rng(0).choice([-1, 1], board.shape)
    brighter = target + 0.1 + 0.1 * np.stack([0 * board, board, signs])
    values = PerceptualLoss(target)(brighter)
    np.testing.assert_allclose(values[:2], [0.040, 0.004], atol=1e-4)
    assert values[2] > values[0]
