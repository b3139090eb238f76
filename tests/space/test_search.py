"""A search over integers, choices and angles by images: the right values are found."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins import FIDE

from .scene import SCENE, render, truth

BUDGET = 1500


def is_right(seed: int) -> bool:
    """Whether a run of 1,500 renders ends with the right floor and number of columns."""
    wanted = truth(seed)
    opt = FIDE(SCENE, render(wanted), seed=seed)
    left = BUDGET
    while left:
        X = opt.ask()[:left]
        np.testing.assert_allclose(
            SCENE.snap(X), X, rtol=0, atol=1e-12
        )  # what is asked is rendered
        opt.tell(X, np.stack([render(params) for params in SCENE.decode_many(X)]))
        left -= len(X)
    assert opt.best is not None
    found = SCENE.decode(opt.best.x)
    return all(found[name] == wanted[name] for name in ("columns", "floor"))


@pytest.mark.slow
def test_nine_of_ten_seeds_end_with_the_right_integer_and_choice() -> None:
    assert sum(is_right(seed) for seed in range(10)) >= 9


def test_a_space_of_numbers_is_searched_as_the_cube_to_the_bit() -> None:
    from fide_plugins import Float, Space

    space = Space(a=Float(-1, 1), b=Float(0.1, 1, log=True), c=Float(0, 9))
    target = np.full((8, 8, 3), 0.5)
    named, plain = FIDE(space, target, seed=1), FIDE(3, target, seed=1)
    for _ in range(20):
        X = plain.ask()
        np.testing.assert_array_equal(named.ask(), X)
        images = np.tile(X.mean(axis=1)[:, None, None, None], (1, 8, 8, 3))
        named.tell(X, images)
        plain.tell(X, images)
    np.testing.assert_array_equal(named.recommend(), plain.recommend())
