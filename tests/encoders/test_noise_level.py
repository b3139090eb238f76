"""How noisy an image is: nothing where it is drawn, and in proportion to noise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import median_filter

import fide_tasks
from fide_plugins.encoders.despeckle import despeckled
from fide_plugins.encoders.noise_level import noise_level

RNG = np.random.default_rng(27)
Image = NDArray[np.float32]


def level(image: Image) -> float:
    return noise_level(image, despeckled(image))


def noisy(size: tuple[int, int], scale: float = 0.05) -> Image:
    return (0.5 + scale * RNG.standard_normal((*size, 3))).astype(np.float32)


@pytest.mark.parametrize(("size", "every"), [((112, 90), 4), ((97, 112), 3), ((20, 400), 1)])
def test_it_is_the_median_over_the_pixels_of_some_rows(size: tuple[int, int], every: int) -> None:
    image = noisy(size)
    away = np.abs(image - median_filter(image, size=(3, 3, 1), mode="nearest")).max(axis=2)
    assert level(image) == np.sort(away[::every].ravel())[away[::every].size // 2]


@pytest.mark.parametrize("name", ["voronoi", "spline", "robot"])
def test_drawings_have_none(name: str) -> None:
    if name == "robot":
        pytest.importorskip("mujoco")
    task = fide_tasks.make(name, 112, 0)
    images = task.render(np.random.default_rng(0).random((4, task.dim)))
    assert [level(image) for image in (*images, task.target)] == [0.0] * 5


def test_it_grows_in_proportion_to_the_noise() -> None:
    image = noisy((112, 112), 0.02)
    for factor in (0.25, 0.5, 2.0, 4.0):
        scaled = (0.5 + factor * (image - 0.5)).astype(np.float32)
        assert level(scaled) == pytest.approx(factor * level(image), rel=1e-4)


def test_it_does_not_depend_on_the_picture_behind() -> None:
    y, x = np.mgrid[:112, :112] / 112
    picture = np.where(np.hypot(x - 0.5, y - 0.4) < 0.3, 0.3, 0.6)[..., None]
    image = noisy((112, 112), 0.02)
    assert level((image - 0.5 + picture).astype(np.float32)) == pytest.approx(
        level(image), rel=0.05
    )
