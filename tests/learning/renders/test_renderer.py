"""What a user's function, or a task, may do while it is learned."""

from __future__ import annotations

import sys
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab.run.task import RendererTask
from fide_plugins.errors import ImageError, RenderError
from fide_plugins.learning import learn
from fide_plugins.learning.rendering import fill
from fide_plugins.learning.renders import Pixels, RenderStore, as_renderer
from fide_plugins.types import Float64

SIDE = 16


def plain(x: Float64) -> Float64:
    """Gray gradient by two numbers."""
    return np.outer(np.linspace(0, x[0], SIDE), np.linspace(0, x[1], SIDE))


class Task:
    """A task that renders by a function of one point.

    most: points of a batch that it can render.
    """

    dim, name = 2, "task"

    def __init__(self, render: Any, most: int) -> None:
        self._render, self._most = render, most

    def render(self, X: Float64) -> Any:
        if len(X) > self._most:
            raise MemoryError("too many")
        return [self._render(x) for x in X]


ONE_BY_ONE = ["function", "points of a task", "own renderer as a task"]
WAYS = [*ONE_BY_ONE, "batches of a task"]


def way(render: Any, how: str) -> Any:
    """One of the ways in which a renderer may be given."""
    if how == "function":
        return render
    if how == "own renderer as a task":
        return RendererTask("task", render, 2)
    return Task(render, 1 if how == "points of a task" else 100)


def renders(source: Any, folder: Path) -> tuple[Float64, Pixels]:
    """A shard, from disk."""
    store = RenderStore(folder, {"dim": 2, "size": [SIDE, SIDE], "seed": 0})
    fill(store, as_renderer(source, 2), 100)
    return store.read(100)


@pytest.mark.parametrize("how", ONE_BY_ONE)
def test_all_images_may_be_drawn_into_one_array(how: str, tmp_path: Path) -> None:
    buffer = np.empty((SIDE, SIDE))

    def reusing(x: Float64) -> Float64:
        buffer[:] = plain(x)
        return buffer

    found = renders(way(reusing, how), tmp_path / "found")
    expected = renders(plain, tmp_path / "expected")
    np.testing.assert_array_equal(found[1], expected[1])


@pytest.mark.parametrize("how", ONE_BY_ONE)
def test_full_images_are_not_kept(how: str, tmp_path: Path) -> None:
    there: list[weakref.ref[Float64]] = []
    most = 0

    def large(x: Float64) -> Float64:
        nonlocal most
        image = np.full((4 * SIDE, 4 * SIDE), x[0])
        there.append(weakref.ref(image))
        most = max(most, sum(each() is not None for each in there))
        return image

    renders(way(large, how), tmp_path)
    assert len(there) == 100 and most <= 2


@pytest.mark.parametrize("how", WAYS)
def test_a_renderer_may_change_its_argument(how: str, tmp_path: Path) -> None:
    def careless(x: Float64) -> Float64:
        image = plain(x)
        x *= 0.5
        return image

    x, images = renders(way(careless, how), tmp_path / "found")
    expected = renders(plain, tmp_path / "expected")
    np.testing.assert_array_equal(x, expected[0])
    np.testing.assert_array_equal(images, expected[1])


@pytest.mark.parametrize("how", WAYS)
@pytest.mark.parametrize("fails", ["raises", "exits", "is no image"])
def test_a_renderer_may_fail_in_the_middle_of_the_space(how: str, fails: str) -> None:
    def singular(x: Float64) -> Float64:
        if x[0] != 0.5:
            return plain(x)
        if fails == "raises":
            raise ZeroDivisionError
        if fails == "exits":
            sys.exit("no light")
        return np.full((SIDE, SIDE), np.nan)

    assert as_renderer(way(singular, how), 2).first_shape() == (SIDE, SIDE)


@pytest.mark.parametrize("how", WAYS)
def test_a_renderer_that_fails_everywhere_says_what_happened_in_the_middle(how: str) -> None:
    def lightless(x: Float64) -> Float64:
        sys.exit(f"no light at {x[0]}")

    def endless(x: Float64) -> Float64:
        return np.full((SIDE, SIDE), np.inf)

    why = "in the middle of the space, and at 4 other points: SystemExit: no light at 0.5$"
    with pytest.raises(RenderError, match=why):
        learn(way(lightless, how), 2)
    name = "endless" if how == "function" else "task"
    with pytest.raises(ImageError, match=f"the image of {name} .*inf"):
        learn(way(endless, how), 2)


@pytest.mark.parametrize("how", WAYS)
def test_a_render_that_exits_has_failed(how: str, tmp_path: Path) -> None:
    def fragile(x: Float64) -> Float64:
        if x[0] < 0.2:
            sys.exit(1)
        return plain(x)

    x, _ = renders(way(fragile, how), tmp_path)
    assert 50 < len(x) < 100 and x[:, 0].min() >= 0.2


def test_an_image_that_is_none_is_called_the_renderers(tmp_path: Path) -> None:
    def odd(x: Float64) -> Any:
        return plain(x) if x[0] == 0.5 else np.zeros(3)

    with pytest.raises(RenderError, match="the first one: the image of odd must have axes"):
        learn(odd, 2, renders=500, size=SIDE)


@pytest.mark.parametrize("how", WAYS)
def test_images_of_another_aspect_have_failed(how: str) -> None:
    """They would be stretched; those of another size alone are taken."""

    def cropped(x: Float64) -> Float64:
        if x[0] < 0.2:
            return plain(x)[: SIDE // 2]
        return plain(x).repeat(2, axis=0).repeat(2, axis=1) if x[0] < 0.4 else plain(x)

    report = learn(way(cropped, how), 2, renders=200, size=SIDE, passes=1).report
    x = [np.random.default_rng((0, shard)).random((100, 2)) for shard in range(2)]
    assert report.failed == (np.concatenate(x)[:, 0] < 0.2).sum()


def test_a_renderer_whose_images_differ_in_aspect_says_so() -> None:
    def turned(x: Float64) -> Float64:
        return plain(x)[: SIDE // 2] if x[0] == 0.5 else plain(x)

    why = r"image of turned has 16 x 16 pixels \(width x height\), and the first one had 16 x 8"
    with pytest.raises(RenderError, match=why):
        learn(turned, 2, renders=500, size=SIDE)
