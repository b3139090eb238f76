"""Exchangeable blocks are found by renders, or declared."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from fide_plugins.errors import OptionError
from fide_plugins.search.mixed import Axes
from fide_plugins.search.scene import Exchangeability, check_groups
from fide_plugins.types import Float64

from ..conftest import additive, painted, sample

Image = Callable[[Float64], Float64]


def contiguous(n: int, length: int, start: int = 0) -> np.ndarray:
    return start + np.arange(n * length).reshape(n, length)


def find(
    dim: int, image: Image, *, seed: int = 0, noise: float = 0.0, most: int = 60
) -> tuple[Exchangeability, int]:
    """What is found for a renderer at a random point, and how many renders that took."""
    rng = np.random.default_rng(seed)

    def render(x: Float64) -> Any:
        return sample(image(x) + noise * rng.standard_normal(16), x)

    found = Exchangeability(Axes(dim), 3)
    here, renders = render(rng.random(dim)), 0
    while not found.finished:
        X = found.draw(here.x)
        renders += len(X)
        found.learn(here, [render(x) for x in X])
    assert renders <= most
    return found, renders


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize(
    "layout",
    [
        contiguous(8, 3),
        contiguous(4, 2),
        contiguous(8, 3).reshape(3, 8).T,
        contiguous(6, 2).reshape(2, 6).T,
    ],
    ids=["contiguous", "few", "strided", "strided pairs"],
)
def test_layouts_without_leftovers_are_found(layout: np.ndarray, noise: float, seed: int) -> None:
    found, renders = find(layout.size, lambda x: additive(x, layout), seed=seed, noise=noise)
    assert found.blocks is not None
    np.testing.assert_array_equal(found.blocks, layout)
    assert not found.ordered and not len(found.leftovers)
    assert renders <= 18


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("start", [0, 5])
def test_leftovers_are_found(start: int, seed: int) -> None:
    """Six lamps of three parameters and a camera of five, after or before them."""
    layout = contiguous(6, 3, start)
    camera = np.setdiff1d(np.arange(23), layout.ravel())

    def image(x: Float64) -> Float64:
        brightness = 1 + x[camera[1:]] @ [1, 2, 3, 4]
        seen: Float64 = brightness * np.roll(additive(x, layout), int(8 * x[camera[0]]))
        return seen

    found, _ = find(23, image, seed=seed, most=70)
    assert found.blocks is not None
    np.testing.assert_array_equal(np.sort(found.blocks, axis=0), layout)
    np.testing.assert_array_equal(found.leftovers, camera)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("dim", [1, 2, 7, 12])
def test_nothing_is_found_where_every_parameter_has_a_meaning_of_its_own(
    dim: int, seed: int
) -> None:
    mixing = np.random.default_rng(100).standard_normal((16, dim))
    found, _ = find(dim, lambda x: np.tanh(mixing @ x), seed=seed)
    assert found.blocks is None and found.chain is None


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("seed", range(5))
def test_a_chain_looks_the_same_in_both_directions(seed: int, noise: float) -> None:
    """Bumps between the neighbors of seven points, and a brightness."""

    def image(x: Float64) -> Float64:
        points = x[:14].reshape(7, 2)
        between = (points[1:] + points[:-1]) / 2
        seen: Float64 = (0.5 + x[14]) * additive(between.ravel(), contiguous(6, 2))
        return seen

    found, _ = find(15, image, seed=seed, noise=noise)
    assert found.blocks is None and found.chain is not None
    np.testing.assert_array_equal(found.chain, contiguous(7, 2))


def test_painted_blocks_are_found_and_known_to_be_ordered() -> None:
    layout = contiguous(6, 2)
    hits = [find(12, lambda x: painted(x, layout), seed=seed)[0] for seed in range(120)]
    right = [f for f in hits if f.blocks is not None and np.array_equal(f.blocks, layout)]
    assert len(right) >= 40, "177 of 400 are; others are too much painted over to tell"
    assert any(f.ordered for f in right)


def test_distance_is_that_of_the_best_order() -> None:
    x = np.array([0.1, 0.2, 0.5, 0.6, 0.8, 0.9, 0.3])
    y = np.array([0.5, 0.6, 0.8, 0.9, 0.1, 0.22, 0.3])
    known = Exchangeability(Axes(7), 3, [[0, 1], [2, 3], [4, 5]])
    assert known.distance(x, y) == pytest.approx(0.02)
    assert Exchangeability(Axes(7), 3, []).distance(x, y) == pytest.approx(0.7)
    y[6] = 0.9
    assert known.distance(x, y) == pytest.approx(0.6)


@pytest.mark.parametrize(
    "groups",
    [
        [[0, 1], [1, 2]], [[0, 0], [1, 2]], [[0, 1], [2]], [[0, 1]], [[], []], [[0, 1], [2, 6]],
        [[0, -1], [2, 3]], [[0, 1.0], [2, 3]], [0, 1],
    ],
)  # fmt: skip
def test_groups_declared_wrongly_are_refused(groups: Any) -> None:
    with pytest.raises(OptionError, match="at least two lists.*from 0 to 5; got") as caught:
        check_groups(groups, 6)
    assert repr(groups) in str(caught.value)


def test_state_goes_on_between_rounds() -> None:
    layout = contiguous(6, 3)
    x = np.random.default_rng(0).random(23)
    here = sample(additive(x, layout), x)
    original = Exchangeability(Axes(23), 3)
    while not original.finished:
        copy = Exchangeability(Axes(23), 3)
        copy.load_state_dict(original.state_dict())
        np.testing.assert_array_equal(copy.draw(x), original.draw(x))
        for each in (original, copy):
            each.learn(here, [sample(additive(row, layout), row) for row in each.draw(x)])
        assert copy.finished == original.finished
    np.testing.assert_array_equal(copy.blocks, original.blocks)
