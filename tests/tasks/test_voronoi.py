"""Voronoi against nearest-neighbor searches of other making, and its generated targets."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray
from scipy.spatial import KDTree

import fide_tasks

Array = NDArray[np.float64]


def pixel_centers(height: int, width: int) -> Array:
    y, x = np.mgrid[:height, :width] + 0.5
    return np.stack([x, y], axis=2)


def by_tree(x: Array, height: int, width: int) -> NDArray[np.float32]:
    """Color pixels by a k-d tree search."""
    cells = x.reshape(-1, 5)
    tree = KDTree(cells[:, :2] * [width, height])
    _, nearest = tree.query(pixel_centers(height, width))
    return cells[nearest, 2:].astype(np.float32)


def by_force(x: Array, height: int, width: int) -> NDArray[np.float32]:
    """Color pixels by comparing all distances; ties go to the cell that sorts first."""
    cells = np.array(sorted(x.reshape(-1, 5).tolist()))
    offsets = pixel_centers(height, width)[:, :, None] - cells[:, :2] * [width, height]
    return cells[(offsets**2).sum(axis=3).argmin(axis=2), 2:].astype(np.float32)


@pytest.mark.parametrize("cells", [1, 2, 8, 60, 300])
@pytest.mark.parametrize("size", [(33, 90), (90, 33), (224, 224)])
def test_equals_a_nearest_neighbor_search(cells: int, size: tuple[int, int]) -> None:
    task = fide_tasks.make("voronoi", size, cells=cells)
    assert task.dim == 5 * cells
    x = np.random.default_rng(cells).random(task.dim)
    np.testing.assert_array_equal(task.render(x[None])[0], by_tree(x, *size))


@settings(max_examples=100, deadline=None)
@given(
    cells=st.lists(st.tuples(*[st.integers(0, 8)] * 5), min_size=1, max_size=9),
    size=st.sampled_from([(8, 8), (16, 8), (8, 32), (16, 16)]),
)
def test_ties_go_to_the_first_in_order(cells: list[tuple[int, ...]], size: tuple[int, int]) -> None:
    # Multiples of 1/8 put centers on one another, in rows and columns, and ties on pixel centers,
    # and all the arithmetic is exact.
    x = np.array(cells).ravel() / 8
    task = fide_tasks.make("voronoi", size, cells=len(cells))
    np.testing.assert_array_equal(task.render(x[None])[0], by_force(x, *size))


@pytest.mark.parametrize("cells", [2, 5])
@pytest.mark.parametrize("size", [(64, 64), (40, 90)])
def test_distance_equals_a_nearest_neighbor_search(cells: int, size: tuple[int, int]) -> None:
    task = fide_tasks.make("voronoi", size, cells=cells, variant="distance")
    assert task.dim == 2 * cells
    x = np.random.default_rng(cells).random(task.dim)
    image = task.render(x[None])[0]
    tree = KDTree(x.reshape(-1, 2) * [size[1], size[0]])
    distance, _ = tree.query(pixel_centers(*size))
    np.testing.assert_allclose(image[:, :, 0], distance / np.hypot(*size), atol=1e-6)
    np.testing.assert_array_equal(image[:, :, 0], image[:, :, 1])
    np.testing.assert_array_equal(image[:, :, 0], image[:, :, 2])


def test_two_cells_as_distance_are_ambiguous_and_their_mean_is_wrong() -> None:
    for seed in range(20):
        task = fide_tasks.make("voronoi", 64, seed, variant="distance")
        x = task.x_star
        assert task.dim == 4
        assert x is not None
        swapped = x[[2, 3, 0, 1]]
        mean = (x + swapped) / 2
        images = task.render(np.stack([x, swapped, mean]))
        np.testing.assert_array_equal(images[0], images[1])
        assert np.abs(images[2] - images[0]).mean() > 0.01
        assert np.linalg.norm(x[:2] - x[2:]) > 0.2


@pytest.mark.parametrize(("cells", "seeds"), [(1, 5), (2, 30), (8, 100), (16, 30), (60, 10)])
def test_generated_targets_are_never_degenerate(cells: int, seeds: int) -> None:
    for seed in range(seeds):
        size = (224, 224) if seed < 5 else (100, 100)
        task = fide_tasks.make("voronoi", size, seed, cells=cells)
        assert task.x_star is not None
        x = task.x_star.reshape(-1, 5)
        height, width = size
        _, label = KDTree(x[:, :2] * [width, height]).query(pixel_centers(height, width))
        area = np.bincount(label.ravel(), minlength=cells) / label.size
        assert area.min() >= 0.27 / cells, f"cell of area {area.min()} at {seed=}"
        for a, b in ((label[:, 1:], label[:, :-1]), (label[1:], label[:-1])):
            for i, j in np.unique(np.stack([a, b], axis=-1)[a != b], axis=0):
                border = ((a == i) & (b == j)).sum() / max(size)
                contrast = np.linalg.norm(x[i, 2:] - x[j, 2:])
                assert contrast >= 0.35 or border < 0.03, f"{contrast=} at {seed=}"
