"""San Miguel: the camera and light are where x says, targets are worth finding, scenes load."""

from __future__ import annotations

import copy
import importlib.util
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import fide_tasks
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


def test_the_light_moves_shadows_but_not_the_sky(task: SanMiguel) -> None:
    up, down = AHEAD.copy(), AHEAD.copy()
    up[3], down[3] = 0.0, 1.0
    lights = np.random.default_rng(4).random((4, 3))
    for x, changes in ((up, False), (down, True)):
        X = np.tile(x, (4, 1))
        X[:, 5:] = lights
        images = task.render(X, seed=[1] * 4)[:, 14:18, 14:18]  # flags hang around the zenith
        assert (np.abs(images - images[0]).max(axis=(1, 2, 3))[1:] > 0.02).all() == changes


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


CUBE_OBJ = "".join(
    f"v {6 + x} {5.5 + y} {1 + z}\n" for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)
) + "".join(
    f"f {a}\n"
    for a in ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
)  # fmt: skip


def test_a_mesh_appears_where_the_camera_should_see_it(tmp_path: Path) -> None:
    path = tmp_path / "cube.obj"
    path.write_text(CUBE_OBJ)
    task = SanMiguel(64, scene=path)
    without = AHEAD.copy()
    without[4] = 0.0  # looking the other way
    image, sky = task.reference(AHEAD), task.reference(without)
    rows, columns = np.nonzero(np.abs(image - sky).max(axis=2) > 0.05)
    # Its front is 9 m away and spans z from 0 to 2, to the right of z = 5, and y from 4.5 to 6.5.
    scale = 32 / np.tan(np.radians(65 / 2)) / 9
    np.testing.assert_allclose([rows.min(), rows.max() + 1], [32 - scale, 32 + scale], atol=1)
    front = gray(image)[31, round(32 + 3.2 * scale) : round(32 + 4.8 * scale)]
    assert columns.max() == pytest.approx(32 + 5 * scale, abs=1)
    assert front.std() < 0.05, "one face, evenly lit"


def test_a_mesh_has_the_colors_of_its_vertices(tmp_path: Path) -> None:
    path = tmp_path / "wall.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\n"
        + "".join(f"property float {name}\n" for name in "xyzrgb")
        + "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        + "".join(
            f"10 {y} {z} 0 {green} 0\n"
            for y, z, green in ((0, 0, 0.1), (0, 10, 0.1), (11, 10, 0.9), (11, 0, 0.9))
        )
        + "3 0 1 2\n3 0 2 3\n"
    )
    image = SanMiguel(32, scene=path, reference_spp=64).reference(AHEAD)[:, 16]
    assert image[:, [0, 2]].max() < 0.05
    assert image[0, 1] > image[-1, 1] + 0.1


@pytest.mark.parametrize(
    ("name", "text"),
    [("a.obj", "v 1 2 x\n"), ("a.obj", "# nothing\n"), ("a.ply", "ply nonsense\n")],
)
def test_meshes_that_cannot_be_used_are_named(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=rf"Mitsuba cannot load the scene .*{re.escape(name)}"):
        SanMiguel(8, scene=tmp_path / name).render(AHEAD[None])


@pytest.mark.parametrize(
    ("options", "error", "rule"),
    [
        ({"scene": "missing.obj"}, FileNotFoundError, r"no scene file '.*missing\.obj'"),
        ({"scene": "court.xml"}, ValueError, r"\.obj, \.ply, not 'court\.xml'"),
        ({"spp": 0}, ValueError, "spp must be a whole number >= 1, not 0"),
        ({"max_depth": 0}, ValueError, "max_depth must be a whole number >= 1"),
        ({"variant": "opencl"}, ValueError, "variant must be one of 'auto'"),
    ],
)
def test_bad_options_are_refused_when_the_task_is_made(
    options: dict[str, Any], error: type[Exception], rule: str
) -> None:
    with pytest.raises(error, match=rule):
        fide_tasks.make("san_miguel", **options)
