"""San Miguel: the camera and light are where x says, targets are worth finding, scenes load."""

from __future__ import annotations

import copy
import importlib.util

import numpy as np
import pytest
from numpy.typing import NDArray

from fide_tasks.san_miguel import SanMiguel
from fide_tasks.viewpoints import merit

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("mitsuba") is None, reason="Mitsuba is not installed (extra mitsuba)"
)

Image = NDArray[np.float32]
AHEAD = np.array([0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5])  # at (16, 5.5, 5), looking along -x


@pytest.fixture(scope="module")
def task() -> SanMiguel:
    return SanMiguel(32, reference_spp=64)


def loss(images: Image, target: Image) -> NDArray[np.float64]:
    squares = (images.astype(np.float64) - target) ** 2
    return np.asarray(squares.mean(axis=(1, 2, 3)))


def gray(image: Image) -> NDArray[np.float64]:
    return np.asarray(image.mean(axis=-1, dtype=np.float64))


def test_parameters_are_the_papers_and_have_units(task: SanMiguel) -> None:
    assert task.dim == 8
    assert task.decode([0, 0, 0, 0, 0, 1, 1, 1]) == {
        "camera": {"x [m]": 7, "y [m]": 1, "z [m]": -2, "theta [deg]": 45, "phi [deg]": 0},
        "light": {"x [m]": 25, "y [m]": 10, "z [m]": 12},
    }
    assert task.decode([1, 1, 1, 1, 1, 0, 0, 0]) == {
        "camera": {"x [m]": 25, "y [m]": 10, "z [m]": 12, "theta [deg]": 135, "phi [deg]": 360},
        "light": {"x [m]": 7, "y [m]": 1, "z [m]": -2},
    }


def test_the_loss_is_lowest_at_x_star(task: SanMiguel) -> None:
    x = task.x_star
    assert x is not None
    rng = np.random.default_rng(2)
    found = loss(task.render(np.tile(x, (5, 1))), task.target)
    near = np.clip(x + rng.normal(0, 0.03, (25, 8)), 0, 1)
    assert found.max() < loss(task.render(near), task.target).min()
    assert found.max() < 0.2 * loss(task.render(rng.random((25, 8))), task.target).min()


def test_phi_closes_its_circle(task: SanMiguel) -> None:
    X = np.tile(AHEAD, (2, 1))
    X[:, 4] = 0, 1
    zero, full = task.render(X, seed=[1, 1])
    assert np.abs(zero - full).mean() < 1e-3


def test_targets_show_a_lit_piece_of_the_court_whatever_the_seed(task: SanMiguel) -> None:
    stars = []
    for seed in range(8):
        one = copy.copy(task)  # shares the loaded scene
        one.__dict__ = {k: v for k, v in task.__dict__.items() if k not in ("_target", "_x_star")}
        one.seed, one.reference_spp = seed, 16
        x = one.x_star
        assert x is not None
        assert ((x > 0) & (x < 1)).all()
        image = gray(one.target)
        assert 0.15 < image.mean() < 0.7, f"too dark or too bright at {seed=}"
        assert image.std() > 0.08, f"even at {seed=}"
        assert (image > 0.97).mean() < 0.2, f"blinding at {seed=}"
        edges = np.abs(np.diff(image, axis=0))[:, 1:] + np.abs(np.diff(image, axis=1))[1:]
        assert (edges > 0.1).mean() > 0.2, f"nothing to see at {seed=}"
        low, width = one._range
        with one.open():
            assert merit(low + x * width, one._cast, 65.0).shortfall == 0
        stars.append(x)
    apart = np.abs(np.array(stars)[:, None] - np.array(stars)).max(axis=2)
    assert apart[~np.eye(8, dtype=bool)].min() > 0.1


def test_x_star_depends_on_the_seed_alone() -> None:
    expected = SanMiguel(32, seed=3).x_star
    assert expected is not None
    for other in (
        SanMiguel((20, 50), seed=3),
        SanMiguel(8, seed=3, spp=1, max_depth=4),
        SanMiguel(8, seed=3, variant="scalar"),
    ):
        np.testing.assert_array_equal(other.x_star, expected)
    one, two = (SanMiguel(16, seed=3, reference_spp=4).target for _ in range(2))
    np.testing.assert_array_equal(one, two)
