"""Starts that are read off a picture: near the answer where it is known."""

from __future__ import annotations

import numpy as np

import fide_tasks
from fide_tasks.picture_start import stroke_of


def error(task: fide_tasks.Task, x: object) -> float:
    return float(np.square(task.render(np.asarray(x)[None])[0] - task.target).mean())


def test_two_halves_are_two_cells() -> None:
    picture = np.zeros((40, 60, 3), np.float32)
    picture[:, 30:] = 1.0, 0.5, 0.0
    task = fide_tasks.make("voronoi", target=picture, cells=2)
    x = task.start()
    assert x is not None and error(task, x) < 1e-9


def test_cells_are_nearer_than_an_even_grid_of_mean_colors() -> None:
    at_start, even = [], []
    for seed in range(4):
        target = fide_tasks.make("voronoi", 48, seed, cells=16).target
        task = fide_tasks.make("voronoi", target=target, cells=16)
        x = task.start()
        assert x is not None
        np.testing.assert_array_equal(x, task.start())
        at_start.append(error(task, x))
        even.append(target.reshape(4, 12, 4, 12, 3).var(axis=(1, 3)).mean())
    assert np.mean(at_start) < 0.8 * np.mean(even)


def test_a_straight_stroke_is_followed_from_end_to_end() -> None:
    true = np.array([0.2, 0.3, 0.5, 0.5, 0.8, 0.7, 0.1])
    drawn = fide_tasks.make("spline", 64, control_points=3).render(true[None])[0]
    task = fide_tasks.make("spline", target=drawn, control_points=3)
    x = task.start()
    assert x is not None and error(task, x) < 0.3 * np.square(drawn - 1).mean()
    steps = np.diff(x[:-1].reshape(-1, 2), axis=0)
    assert (steps > 0).all() or (steps < 0).all()
    assert 0.05 < x[-1] < 0.2


def test_there_is_no_start_where_the_pixels_say_nothing() -> None:
    assert stroke_of(np.ones((8, 8, 3), np.float32), 3) is None
    assert fide_tasks.make("voronoi", 16, variant="distance").start() is None
    assert fide_tasks.make("lamps", 16).start() is None
