"""Whether an image differs from the target by noise of its pixels alone."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins.types import Float32, Float64
from fide_plugins.views import Views
from fide_plugins.views.findings import PixelNoise, is_even_noise, is_noise

SIDE = 48
V, U = np.mgrid[0:SIDE, 0:SIDE] / (SIDE - 1)


def disk(x: float, y: float) -> Float64:
    """A soft disk (H, W, 3) on gray."""
    gray = 0.3 + 0.4 / (1 + np.exp(80 * ((U - x) ** 2 + (V - y) ** 2 - 0.04)))
    return np.repeat(gray[..., None], 3, axis=-1)


def noisy(image: Float64, std: float, rng: np.random.Generator) -> Float32:
    """Image with noise of its own in each pixel, the same in all colors."""
    return (image + std * rng.standard_normal((SIDE, SIDE, 1))).astype(np.float32)


def measured(views: Views, std: float, rng: np.random.Generator) -> PixelNoise:
    """Of two renders of a candidate that is far from the target."""
    pixel_noise = PixelNoise(views)
    for _ in range(2):
        pixel_noise.note(noisy(disk(0.2, 0.8), std, rng))
    return pixel_noise


@pytest.mark.parametrize("of_target", [0.0, 0.05])
def test_noise_is_all_that_is_left_of_the_right_image_and_of_no_other(of_target: float) -> None:
    """Also where the target has as much."""
    rng = np.random.default_rng(0)
    views = Views.read(noisy(disk(0.6, 0.4), of_target, rng))
    pixel_noise = measured(views, 0.05, rng)
    assert pixel_noise.variance == pytest.approx(0.05**2, rel=0.1)
    right = [noisy(disk(0.6, 0.4), 0.05, rng) for _ in range(100)]
    wrong = [noisy(disk(0.65, 0.4), 0.05, rng) for _ in range(100)]
    assert sum(pixel_noise.left(image, views.target) is not None for image in right) >= 98
    assert views.squared_error(wrong[0]) < 2 * views.squared_error(right[0]), "by loss it may be"
    assert not any(pixel_noise.left(image, views.target) for image in wrong)


@pytest.mark.parametrize("of_renderer", [0.0, 0.02])
def test_the_target_may_have_more_noise_than_the_renderer(of_renderer: float) -> None:
    """Which may have none.  Whether it has any must be known."""
    rng = np.random.default_rng(0)
    found, seen = 0, 0
    for _ in range(30):
        views = Views.read(noisy(disk(0.6, 0.4), 0.05, rng))
        pixel_noise = measured(views, of_renderer, rng)
        right = noisy(disk(0.6, 0.4), of_renderer, rng)
        std = pixel_noise.left(right, views.target)
        found += std == pytest.approx((0.05**2 + of_renderer**2) ** 0.5, rel=0.1)
        seen += pixel_noise.left(noisy(disk(0.64, 0.4), of_renderer, rng), views.target) is not None
        assert PixelNoise(views).left(right, views.target) is None
    assert found >= 28 and not seen


def test_edges_that_differ_in_few_pixels_are_no_noise_of_the_target() -> None:
    """Of a clean picture, with hard edges: they lie here and there."""
    rng = np.random.default_rng(0)
    sparse = rng.standard_normal((64, 64, 1)) * (rng.random((64, 64, 1)) < 0.2)
    assert is_noise(sparse) and not is_even_noise(sparse, 64 * 64)


def spot(width: float, peak: float, x: float, y: float) -> Float64:
    """A Gaussian spot (64, 64, 3) with its center at pixel x, y; width in pixels."""
    rows, columns = np.mgrid[0:64, 0:64]
    gray = peak * np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / (2 * width**2))
    return np.repeat(gray[..., None], 3, axis=-1)


@pytest.mark.parametrize(("width", "peak"), [(0.63, 0.4), (1, 0.25), (1.9, 0.12), (3, 0.08)])
def test_a_spot_that_the_eye_sees_in_noise_is_no_noise(width: float, peak: float) -> None:
    """The difference has it where the image lacks it; noise has a standard deviation of 0.05."""
    rng = np.random.default_rng(0)
    seen = 0
    for _ in range(60):
        noise = np.repeat(0.05 * rng.standard_normal((64, 64, 1)), 3, axis=-1)
        thing = spot(width, peak, *rng.uniform(5, 59, 2))
        seen += not is_even_noise(thing + noise, 64 * 64)
    assert seen >= 51


@pytest.mark.parametrize("side", [64, 200])
@pytest.mark.parametrize("colors", [1, 3])
def test_noise_alone_is_noise(side: int, colors: int) -> None:
    rng = np.random.default_rng(0)
    number = 200 if side == 64 else 40
    noise = [
        np.repeat(rng.standard_normal((side, side, colors)), 3 // colors, axis=-1)
        for _ in range(number)
    ]
    assert sum(not is_even_noise(one, side**2) for one in noise) <= 0.01 * number + 1
    assert sum(not is_noise(one) for one in noise) <= 0.01 * number + 1


def test_views_and_weights_count_as_in_the_loss() -> None:
    rng = np.random.default_rng(0)
    mask = np.ones((SIDE, SIDE), np.float32)
    mask[:, :10] = 0
    views = Views.read([disk(0.6, 0.4), disk(0.3, 0.3)], [mask, None])

    def renders(x: float, hidden: float) -> Float32:
        pictures = [noisy(disk(x, 0.4), 0.05, rng), noisy(disk(0.3, 0.3), 0.05, rng)]
        pictures[0][:, :10] = hidden
        batch = views.as_batch([one[None] for one in pictures], 1, print)
        return np.asarray(batch[0], np.float32)

    pixel_noise = PixelNoise(views)
    for hidden in (0.0, 1.0):
        pixel_noise.note(renders(0.2, hidden))
    assert pixel_noise.variance == pytest.approx(0.05**2, rel=0.1)
    right = renders(0.6, 0.0)
    left = pixel_noise.left(right, views.target)
    assert left and pixel_noise.left(right, views.target) == left, "asked again, it knows"
    assert not pixel_noise.left(renders(0.65, 0.0), views.target)


def test_it_goes_on_between_the_two_renders() -> None:
    rng = np.random.default_rng(0)
    views = Views.read(disk(0.6, 0.4))
    first, second = (noisy(disk(0.2, 0.8), 0.05, rng) for _ in range(2))
    one, other = PixelNoise(views), PixelNoise(views)
    one.note(first)
    other.load_state_dict(one.state_dict(), {"H": SIDE, "W": SIDE})
    for pixel_noise in (one, other):
        pixel_noise.note(second)
    assert one.variance == other.variance is not None
    one.note(first)
    one.repeat = None
    one.note(second)
    assert one.variance == other.variance, "renders of another candidate are no measure"
    with pytest.raises(ValueError, match="variance"):
        other.load_state_dict({"variance": -1.0, "repeat": None}, {"H": SIDE, "W": SIDE})
