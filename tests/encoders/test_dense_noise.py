"""`dense` on noisy images: smoothed as much as they are noisy, and others not at all."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import fide_tasks
from fide_plugins.encoders.dense import DenseEncoder, grid, sampled
from fide_plugins.encoders.despeckle import despeckled

RNG = np.random.default_rng(28)
Images = NDArray[np.float32]


def without_smoothing(images: Images) -> torch.Tensor:
    """Tokens as version 3 made them."""
    rows, columns = grid(*images.shape[1:3])
    samples = [sampled(despeckled(image), 2 * rows, 2 * columns) for image in images]
    return DenseEncoder()._encode(torch.from_numpy(np.stack(samples).clip(0, 1)))


def picture() -> Images:
    """A smooth picture with an edge, (112, 112, 3)."""
    y, x = (np.mgrid[:112, :112] + 0.5) / 112
    image = np.stack([0.3 + 0.3 * x, 0.6 - 0.3 * y, 0.2 + 0.3 * x * y], axis=-1)
    image[np.hypot(x - 0.5, y - 0.4) < 0.25] = (0.8, 0.3, 0.5)
    return image.astype(np.float32)


def noise(scale: float) -> Images:
    return (scale * RNG.standard_normal((112, 112, 3))).astype(np.float32)


@pytest.mark.parametrize("size", [112, 224])
@pytest.mark.parametrize("name", ["voronoi", "spline", "robot"])
def test_images_without_noise_are_not_smoothed(name: str, size: int) -> None:
    """Bit for bit: what was measured with version 3 holds."""
    if name == "robot":
        pytest.importorskip("mujoco")
    task = fide_tasks.make(name, size, 1)
    images = task.render(np.random.default_rng(1).random((4, task.dim)))
    assert torch.equal(DenseEncoder()(images), without_smoothing(images))


def test_noise_is_smoothed_away_and_edges_stay() -> None:
    clean = picture()
    images = np.stack([clean + noise(0.1) for _ in range(8)]).clip(0, 1)
    expected = DenseEncoder()(clean[None])
    before, after = (
        (tokens - expected).square().mean().sqrt()
        for tokens in (without_smoothing(images), DenseEncoder()(images))
    )
    assert after < 0.75 * before
    contrast = expected[0, :, 3:9].abs().amax()
    assert DenseEncoder()(images)[:, :, 3:9].abs().amax() > 0.6 * contrast


def test_no_amount_of_noise_makes_a_jump() -> None:
    """The largest change of the features shrinks with the change of the noise."""
    clean, grain = picture(), noise(0.1)

    def largest_step(steps: int) -> float:
        scales = np.linspace(0, 0.2, steps + 1, dtype=np.float32)  # from no smoothing to all of it
        images = np.stack([clean + s * grain for s in scales]).clip(0, 1)
        return float(DenseEncoder()(images).diff(dim=0).flatten(1).norm(dim=1).max())

    assert largest_step(80) < 0.3 * largest_step(20)
