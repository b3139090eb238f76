import numpy as np
import pytest
from numpy.typing import NDArray

from fide_plugins.images import Float32
from fide_plugins.losses.base import LossOfTarget
from fide_plugins.losses.mse import MeanSquaredError
from fide_plugins.losses.perceptual import PerceptualLoss

RNG = np.random.default_rng(8)


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


@pytest.mark.parametrize(("a", "b"), [(0.0, 1.0), (0.25, 0.5), (0.5, 0.5)])
def test_constant_images_differ_by_their_color_alone(a: float, b: float) -> None:
    """4 |v - v'|^2, in gray: 4 (a - b)^2."""
    value = PerceptualLoss(np.full((40, 50), a))(np.full((1, 40, 50), b))[0]
    np.testing.assert_allclose(value, 4 * (a - b) ** 2, atol=1e-6)


def test_constant_colors_by_hand() -> None:
    color = np.array([0.8, 0.4, 0.2])
    luma = color @ (0.299, 0.587, 0.114)
    opponent = (luma, (color[2] - luma) / 1.772, (color[0] - luma) / 1.402)  # Rec. 601
    value = PerceptualLoss(np.zeros((20, 20, 3)))(np.broadcast_to(color, (1, 20, 20, 3)))[0]
    np.testing.assert_allclose(value, 4 * np.sum(np.square(opponent)), rtol=1e-5)


def test_structure_counts_relative_to_contrast() -> None:
    """Missing structure costs nearly 1, inverted structure nearly 2, whatever its contrast."""
    blocks = RNG.choice([-1.0, 1.0], (7, 7)).repeat(16, axis=0).repeat(16, axis=1)
    for contrast in (0.25, 0.5):
        loss = PerceptualLoss(0.5 + contrast * blocks)
        flat, inverted = loss(np.stack([np.full(blocks.shape, 0.5), 0.5 - contrast * blocks]))
        color = 4 * contrast**2  # what the term of coarse colors adds at most, inverted 4 times
        assert 0.8 < flat < 1 + color
        assert 1.7 < inverted < 2 + 4 * color


def test_bounded() -> None:
    images = (RNG.random((4, 60, 60, 1)) > 0.5).repeat(3, axis=3)
    values = PerceptualLoss(images[0])(images)
    assert values[0] == 0 and np.all(values[1:] < 2 + 4)


def noise_over_difference(kind: type[LossOfTarget]) -> float:
    """Distance of noisy renders of one scene over the median distance of different scenes."""
    rng = np.random.default_rng(9)
    scenes = [noisy(scene(rng), rng) for _ in range(12)]
    rng = np.random.default_rng(9)
    same = noisy(scene(rng), np.random.default_rng(10))
    loss = kind(scenes[0])
    return float(loss(same[None])[0] / np.median(loss(scenes[1:])))


def test_noise_counts_less_than_for_mse() -> None:
    perceptual, mse = noise_over_difference(PerceptualLoss), noise_over_difference(MeanSquaredError)
    assert perceptual < 0.11 and perceptual < mse / 2, (perceptual, mse)


def test_a_noisy_target_is_still_found() -> None:
    """Among renders with noise, the scene itself is nearest; the farther moved, the farther."""
    rng = np.random.default_rng(11)
    image = scene(rng)
    moved = [np.roll(image, shift, axis=1) for shift in (0, 2, 4, 8, 16)]
    values = PerceptualLoss(noisy(image, rng))([noisy(x, rng) for x in moved])
    assert np.all(np.diff(values) > 0)
