"""Lamps, sprites and ball against their formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

import fide_tasks
from fide_tasks import Task, ball

Array = NDArray[np.float64]


def unit(task: Task, values: Array) -> Array:
    """The parameters in [0, 1] of physical values."""
    low, high = np.array([(p.low, p.high) for p in task.parameters]).T
    return np.asarray((values - low) / (high - low))


def rgb(image: NDArray[np.float32]) -> NDArray[np.float64]:
    return image.astype(np.float64)


# -- lamps -----------------------------------------------------------------------------------------


def radiance(task: Task, x: Array) -> Array:
    """Undo the exposure."""
    stops = task.decode(x)["camera"]["exposure [stops]"]
    return np.asarray(-np.log(1 - rgb(task.render(x[None])[0])) / 2**stops)


def test_light_adds_up() -> None:
    task = fide_tasks.make("lamps", 48, lamps=2)
    x = np.random.default_rng(0).random(14)
    dark = x.copy()
    dark[[3, 4, 5, 9, 10, 11]] = 0
    first, second = x.copy(), x.copy()
    first[9:12], second[3:6] = 0, 0
    together = radiance(task, x) - radiance(task, dark)
    apart = radiance(task, first) + radiance(task, second) - 2 * radiance(task, dark)
    np.testing.assert_allclose(together, apart, atol=1e-5)


def test_a_lamp_falls_off_as_a_point_before_a_wall() -> None:
    """The same lamp farther up: the ratio of two places follows the law of the cosine."""
    task = fide_tasks.make("lamps", 101, lamps=1)
    h, r = 0.2, 30 / 101
    values = np.array([0.0, 0.0, h, 1.0, 1.0, 1.0, 0.0, 0.0])
    lit = radiance(task, unit(task, values))
    values[3:7] = 0.0, 0.0, 0.0, 0.3
    albedo = radiance(task, unit(task, values)) / 0.3
    irradiance = lit / albedo
    np.testing.assert_allclose(irradiance[50, 50], 1, rtol=1e-5)
    np.testing.assert_allclose(irradiance[50, 20], (1 + (r / h) ** 2) ** -1.5, rtol=1e-5)
    np.testing.assert_allclose(irradiance[80, 50], (1 + (r / h) ** 2) ** -1.5, rtol=1e-5)


# -- sprites ---------------------------------------------------------------------------------------


def sprite(task: Task, depth: float, color: tuple[float, ...], x: float = 0.0) -> Array:
    return np.array([x, 0.0, 0.2, 0.0, depth, 0.5, *color])


RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def test_the_nearer_sprite_covers_the_other_whatever_their_order() -> None:
    task = fide_tasks.make("sprites", 65, sprites=2)
    for near, far, seen in [(RED, BLUE, RED), (BLUE, RED, BLUE)]:
        pair = [sprite(task, 0.2, near), sprite(task, 0.7, far)]
        for order in (pair, pair[::-1]):
            image = task.render(unit(task, np.concatenate(order))[None])[0]
            np.testing.assert_allclose(image[32, 32], seen, atol=1e-6)


@pytest.mark.parametrize(("shape", "petals"), [(0.0, 3), (0.5, 4), (1.0, 5)])
def test_the_outline_has_as_many_petals_as_the_formula(shape: float, petals: int) -> None:
    """The half-way contour of a sharp sprite is R = size (1 + 0.28 cos(k phi)), turned by angle."""
    task = fide_tasks.make("sprites", 401, sprites=1)
    values = np.array([0.0, 0.0, 0.2, 17.0, 0.0, shape, 0.0, 0.0, 0.0])
    image = rgb(task.render(unit(task, values)[None])[0])
    empty = values.copy()
    empty[0] = -0.5  # elsewhere
    background = rgb(task.render(unit(task, empty)[None])[0])[:, 350]
    for phi in np.radians(np.arange(0, 360, 15)):
        radius = 0.2 * (1 + 0.28 * math.cos(petals * (phi - math.radians(17))))
        column, row = (round(200 + 401 * radius * f(phi)) for f in (math.cos, math.sin))
        covered = 1 - image[row, column, 0] / background[row, 0]
        r = math.hypot(column - 200, row - 200) / 401
        seen_at = math.atan2(row - 200, column - 200) - math.radians(17)
        exact = 0.2 * (1 + 0.28 * math.cos(petals * seen_at))
        t = min(max((exact - r) / 0.02 + 0.5, 0), 1)
        assert abs(covered - t * t * (3 - 2 * t)) < 1e-3


# -- ball ------------------------------------------------------------------------------------------


def test_a_light_is_brightest_where_the_ball_faces_it() -> None:
    """Without gloss in the way: the diffuse part of the formula, at the pixel of a normal."""
    task = fide_tasks.make("ball", 201)
    values = np.array([0, 0, 0, 0, 0, 0, 60.0, 20.0, 1.0, 0.0])
    image = rgb(task.render(unit(task, values)[None])[0])
    light = ball.direction(60, 20)
    half = light + np.array([0, 0, 1])
    half /= np.linalg.norm(half)
    green = np.array([0.30, 0.90, 0.20])
    for column, row in [(100, 100), (150, 80), (60, 130)]:
        x, y = (column - 100) / 201 / 0.42, (row - 100) / 201 / 0.42
        n = np.array([x, y, math.sqrt(1 - x * x - y * y)])
        lit = 0.5 * ((1 + n @ light) / 2) ** 2 + 0.6 * math.exp(25 * (n @ half - 1))
        np.testing.assert_allclose(image[row, column], 1 - np.exp(-1.5 * green * lit), atol=1e-5)
