"""The channels of `dense`, and what it does with noise."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from scipy.ndimage import median_filter

import fide_tasks
from fide_plugins.encoders.dense import (
    SMALLEST,
    DenseEncoder,
    box_weights,
    despeckled,
    grid,
    noise_level,
    sampled,
)

RNG = np.random.default_rng(3)
MEAN, RIGHT, DOWN, DIAGONAL = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
EDGES = slice(12, 16)


def encode(images: np.ndarray) -> np.ndarray:
    """Tokens [n, gh, gw, C] of images."""
    tokens = DenseEncoder()(images).numpy()
    return tokens.reshape(len(images), *grid(*images.shape[1:3]), -1)


def smooth(size: int) -> np.ndarray:
    """One image of a few colored waves, the same scene at any size."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    waves = [
        np.sin(2 * np.pi * (a * x + b * y) + c) for a, b, c in ((1, 2, 0), (3, 1, 1), (2, -2, 2))
    ]
    return (np.stack(waves, axis=-1)[None] / 2 + 0.5).astype(np.float32)


@pytest.mark.parametrize("size", [(224, 224), (30, 50), (5, 5), (1, 1)])
@pytest.mark.parametrize("color", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.25, 0.5, 0.75)])
def test_a_constant_image_has_its_color_and_nothing_else(
    size: tuple[int, int], color: tuple[float, float, float]
) -> None:
    tokens = encode(np.full((1, *size, 3), color, np.float32))
    np.testing.assert_allclose(
        tokens[..., MEAN], np.broadcast_to(color, tokens[..., MEAN].shape), atol=1e-6
    )
    np.testing.assert_allclose(tokens[..., 3:], 0.0, atol=2e-6)


def test_the_first_channels_are_mean_colors() -> None:
    image = RNG.random((2, 50, 100, 3), dtype=np.float32)  # too small to have specks
    assert grid(50, 100) == (10, 20)
    tokens = encode(image)  # 5 x 5 pixels a patch
    expected = image.reshape(2, 10, 5, 20, 5, 3).mean(axis=(2, 4))
    np.testing.assert_allclose(tokens[..., MEAN], expected, atol=1e-6)


def test_contrasts_by_hand() -> None:
    image = np.zeros((1, 56, 56, 3), np.float32)  # 14 x 14 patches of 4 x 4 pixels
    image[0, :4, 2:4] = (0.5, 0.25, 0.0)  # patch (0, 0): right half
    image[0, 6:8, 4:8] = 0.5  # patch (1, 1): lower half
    image[0, 8:10, 8:10] = image[0, 10:12, 10:12] = 0.5  # patch (2, 2): main diagonal
    tokens = encode(image)[0]
    np.testing.assert_allclose(tokens[0, 0, 3:12], [0.5, 0.25, 0] + [0] * 6, atol=1e-6)
    np.testing.assert_allclose(tokens[1, 1, 3:12], [0] * 3 + [0.5] * 3 + [0] * 3, atol=1e-6)
    np.testing.assert_allclose(tokens[2, 2, 3:12], [0] * 6 + [0.5] * 3, atol=1e-6)


@pytest.mark.parametrize(
    ("direction", "channel"),
    [
        ((1, 0), 0),
        ((-1, 0), 0),
        ((0, 1), 1),
        ((0, -1), 1),
        ((1, -1), 2),
        ((1, 1), 3),
        ((-1, -1), 3),
    ],
)
def test_edges_answer_to_their_direction(direction: tuple[int, int], channel: int) -> None:
    """The luminance grows along `direction` (x, y); an edge is perpendicular to it."""
    y, x = np.mgrid[:56, :56] / 56
    ramp = (0.5 + 0.2 * (direction[0] * x + direction[1] * y)).astype(np.float32)
    tokens = encode(np.repeat(ramp[None, ..., None], 3, axis=3))[0, 2:-2, 2:-2]
    slope = 0.2 * np.hypot(*direction) / 56
    expected = np.zeros(4)
    expected[channel] = slope * 4  # from the sample before to the one behind, of 2 pixels each
    np.testing.assert_allclose(
        tokens[..., EDGES], np.broadcast_to(expected, (10, 10, 4)), atol=1e-5
    )


def test_a_shift_by_a_patch_shifts_tokens_where_nothing_is_smoothed() -> None:
    image = smooth(112)
    tokens, shifted = encode(image), encode(np.roll(image, (8, 16), axis=(1, 2)))
    np.testing.assert_allclose(shifted[:, 2:13, 3:13], tokens[:, 1:12, 1:11], atol=1e-6)


def test_the_transposed_image_swaps_directions() -> None:
    image = RNG.random((1, 60, 60, 3), dtype=np.float32)
    tokens = encode(image).transpose(0, 2, 1, 3)
    transposed = encode(np.ascontiguousarray(image.transpose(0, 2, 1, 3)))
    order = [0, 1, 2, 6, 7, 8, 3, 4, 5, 9, 10, 11, 13, 12, 14, 15]
    np.testing.assert_allclose(transposed, tokens[..., order], atol=1e-5)


@pytest.mark.parametrize("size", [(112, 112), (90, 150)])
def test_specks_are_not_seen(size: tuple[int, int]) -> None:
    """One pixel in 3 x 3 of a smooth image is white or black."""
    y, x = (np.mgrid[: size[0], : size[1]] + 0.5) / 112
    image = np.stack([0.3 + 0.2 * x, 0.5 - 0.2 * y, 0.2 + 0.1 * x * y], axis=-1)
    specked = image.copy()
    specked[1::3, 1::3] = RNG.choice([0.0, 1.0], specked[1::3, 1::3].shape)
    clean, noisy = encode(np.stack([image, specked]).astype(np.float32))
    np.testing.assert_allclose(noisy, clean, atol=0.01)
    assert np.abs(encode(specked[None, :80, :80])[0] - encode(image[None, :80, :80])[0]).max() > 0.1


@settings(max_examples=300, deadline=None)
@given(st.integers(1, 5000), st.integers(1, 5000))
def test_the_grid_is_bounded(height: int, width: int) -> None:
    rows, columns = grid(height, width)
    assert 1 <= rows <= height and 1 <= columns <= width and rows * columns <= 256
    assert grid(width, height) == (columns, rows)


@pytest.mark.parametrize("size", [(1, 1), (1, 300), (16, 4096), (4096, 16), (3, 2), (700, 500)])
def test_extreme_sizes(size: tuple[int, int]) -> None:
    images = RNG.random((2, *size, 3), dtype=np.float32)
    tokens = encode(images)
    assert np.isfinite(tokens).all()
    assert tokens[..., MEAN].min() >= 0 and tokens[..., MEAN].max() <= 1
    assert tokens[..., 3:12].min() >= -1.00001 and tokens[..., 3:12].max() <= 1.00001
    assert tokens[..., 12:].min() >= 0 and tokens[..., 12:].max() <= np.sqrt(2) + 1e-5


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 200), st.integers(1, 60))
def test_boxes_share_out_every_pixel(pixels: int, boxes: int) -> None:
    weights = box_weights(pixels, boxes).astype(np.float64)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(weights.sum(axis=0), boxes / pixels, atol=1e-5, rtol=1e-5)


# -- noise -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "changed"),
    [((SMALLEST, 101), True), ((SMALLEST, SMALLEST - 1), False), ((1, 9000), True)],
)
def test_despeckled_images_are_medians_but_small_ones_stay(
    size: tuple[int, int], changed: bool
) -> None:
    image = RNG.random((*size, 3), dtype=np.float32)
    before = image.copy()
    medians = median_filter(image, size=(3, 3, 1), mode="nearest")
    np.testing.assert_array_equal(despeckled(image), medians if changed else image)
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize(("size", "every"), [((112, 90), 4), ((97, 112), 3), ((20, 400), 1)])
def test_the_noise_level_is_a_median_over_some_rows(size: tuple[int, int], every: int) -> None:
    image = (0.5 + 0.05 * RNG.standard_normal((*size, 3))).astype(np.float32)
    clean = despeckled(image)
    away = np.abs(image - clean).max(axis=2)[::every].ravel()
    assert noise_level(image, clean) == np.sort(away)[away.size // 2]


def without_smoothing(images: np.ndarray) -> torch.Tensor:
    """Tokens of images that are despeckled only."""
    rows, columns = grid(*images.shape[1:3])
    samples = [sampled(despeckled(image), 2 * rows, 2 * columns) for image in images]
    return DenseEncoder()._encode(torch.from_numpy(np.stack(samples).clip(0, 1)))


@pytest.mark.parametrize("name", ["voronoi", "spline", "robot"])
def test_images_without_noise_are_not_smoothed(name: str) -> None:
    if name == "robot":
        pytest.importorskip("mujoco")
    task = fide_tasks.make(name, 112, 1)
    images = task.render(np.random.default_rng(1).random((4, task.dim)))
    assert [noise_level(image, despeckled(image)) for image in images] == [0.0] * 4
    assert torch.equal(DenseEncoder()(images), without_smoothing(images))


def picture() -> np.ndarray:
    """A smooth picture with an edge, (112, 112, 3)."""
    y, x = (np.mgrid[:112, :112] + 0.5) / 112
    image = np.stack([0.3 + 0.3 * x, 0.6 - 0.3 * y, 0.2 + 0.3 * x * y], axis=-1)
    image[np.hypot(x - 0.5, y - 0.4) < 0.25] = (0.8, 0.3, 0.5)
    return image.astype(np.float32)


def noise(scale: float) -> np.ndarray:
    return (scale * RNG.standard_normal((112, 112, 3))).astype(np.float32)


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
