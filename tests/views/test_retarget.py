"""The next picture of several views, and of pictures of which a part is hidden."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from fide_plugins import FIDE
from fide_plugins.errors import ImageError
from fide_plugins.types import Float32, Float64

Render = Callable[[Float64], Float32]
Images = Callable[[Float64], Any]
MASK = np.ones((16, 16), np.float32)
MASK[:, 11:] = 0
HALF = np.full((8, 16), 1, np.float32)
HALF[:, :4] = 0.5


def spoiled(picture: Float32, seed: int) -> Float32:
    """The picture with noise where `MASK` hides it."""
    noise = np.random.default_rng(seed).random(picture.shape, np.float32)
    return np.where(MASK[..., None] > 0, picture, noise)


@pytest.fixture(params=["views", "mask", "views and weights"])
def scene(request: pytest.FixtureRequest, render: Render) -> tuple[Images, Images, dict[str, Any]]:
    """Renders, pictures to find, and options."""

    def both(X: Float64) -> list[Float32]:
        images = render(X)
        return [images, images[:, 4:12].copy()]

    def pair(X: Float64) -> list[Float32]:
        return [images[0] for images in both(X)]

    def masked(X: Float64) -> Float32:
        return spoiled(render(X)[0], int(1000 * X[0, 0]))

    scenes: dict[str, tuple[Images, Images, dict[str, Any]]] = {
        "views": (both, pair, {}),
        "mask": (render, masked, {"mask": MASK}),
        "views and weights": (both, pair, {"weights": [None, HALF]}),
    }
    return scenes[request.param]


def go_on(opt: FIDE, images: Images, n: int) -> Float64:
    asked = []
    for _ in range(n):
        asked.append(opt.ask(3))
        opt.tell(asked[-1], images(asked[-1]))
    return np.concatenate(asked)


def test_a_picture_that_was_rendered_is_found_at_once(
    scene: tuple[Images, Images, dict[str, Any]], answer: Float64
) -> None:
    images, pictures, options = scene
    opt = FIDE(6, pictures(answer[None]), seed=1, popsize=8, **options)
    x = go_on(opt, images, 30)[40]
    weights = opt.weights
    opt.retarget(pictures(x[None]))
    first = opt.ask(1)
    np.testing.assert_array_equal(first[0], x)
    opt.tell(first, images(first))
    assert opt.best is not None and opt.best.loss < 1e-12 and opt.status.code == "solved"
    pairs = [(opt.weights, weights)]
    if isinstance(weights, list):
        pairs = list(zip(opt.weights, weights, strict=True))
    assert all(one is other or np.array_equal(one, other) for one, other in pairs)


def test_what_the_next_picture_hides_has_no_influence(render: Render, answer: Float64) -> None:
    runs = []
    for noise in (1, 2):
        opt = FIDE(6, spoiled(render(answer[None])[0], noise), mask=MASK, seed=1, popsize=8)
        first = go_on(opt, render, 12)
        opt.retarget(spoiled(render(answer[None] * 0.9)[0], 7 * noise))
        runs.append(np.concatenate([first, go_on(opt, render, 12)]))
    np.testing.assert_array_equal(runs[0], runs[1])


def test_the_number_and_the_sizes_of_views_stay(render: Render, target: Float32) -> None:
    opt = FIDE(6, [target, target[:8]], seed=1, popsize=8)
    for wrong in (target, [target], [target[:8], target], [target, target[:8], target]):
        with pytest.raises(ImageError, match=r"size of the first, 16 x 16 \+ 8 x 16"):
            opt.retarget(wrong)
    opt.retarget([target[::-1], target[8:]])
    np.testing.assert_array_equal(opt.target[1], target[8:])
