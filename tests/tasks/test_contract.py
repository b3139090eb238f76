"""What every task promises, over all tasks and variants, and what the base does for noisy ones."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import fide_tasks
from fide_tasks import Parameter, Task

CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "voronoi": ("voronoi", {}),
    "voronoi, 1 cell": ("voronoi", {"cells": 1}),
    "voronoi, 60 cells": ("voronoi", {"cells": 60}),
    "voronoi, distance": ("voronoi", {"variant": "distance"}),
    "spline": ("spline", {}),
    "spline, random": ("spline", {"target": "random"}),
    "spline, 2 points": ("spline", {"target": "random", "control_points": 2}),
    "robot": ("robot", {}),
    "lamps": ("lamps", {}),
    "lamps, 1 lamp": ("lamps", {"lamps": 1}),
    "sprites": ("sprites", {}),
    "sprites, 1 sprite": ("sprites", {"sprites": 1}),
    "stick_figure": ("stick_figure", {}),
    "arm": ("arm", {}),
    "lens": ("lens", {}),
    "ball": ("ball", {}),
    "triangles": ("triangles", {}),
    "triangles, random": ("triangles", {"target": "random", "triangles": 8}),
}
NOISY = ("beads", "san_miguel")
Make = Callable[..., Task]


@pytest.fixture(params=CASES, ids=list(CASES))
def make(request: pytest.FixtureRequest) -> Make:
    name, options = CASES[request.param]
    if name == "robot":
        request.getfixturevalue("opengl")

    def factory(size: int | tuple[int, int] = 48, seed: int = 0, **more: Any) -> Task:
        return fide_tasks.make(name, size, seed, **{**options, **more})

    return factory


@pytest.fixture(params=[*CASES, *NOISY])
def task(request: pytest.FixtureRequest) -> Task:
    """A small task, noisy or not; the same in all tests, since targets take time to draw."""
    if request.param in NOISY:
        pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install mitsuba")
    if request.param == "robot":
        request.getfixturevalue("opengl")
    return _small(request.param)


@cache
def _small(case: str) -> Task:
    if case in NOISY:
        return fide_tasks.make(case, (6, 9), spp=1, reference_spp=4)
    name, options = CASES[case]
    return fide_tasks.make(name, 48, **options)


def loss(images: NDArray[np.float32], target: NDArray[np.float32]) -> NDArray[np.float64]:
    squares = (images.astype(np.float64) - target) ** 2
    return np.asarray(squares.mean(axis=(1, 2, 3)))


def test_random_candidates_give_valid_images(task: Task) -> None:
    n = 20 if task.stochastic else 60  # noisy tasks have tests of their own for more
    images = task.render(np.random.default_rng(0).random((n, task.dim)))
    assert images.shape == (n, *task.shape)
    assert images.dtype == np.float32
    assert images.flags.c_contiguous
    assert np.isfinite(images).all()
    assert images.min() >= 0
    assert images.max() <= 1


def test_any_height_and_width(make: Make) -> None:
    for size in ((30, 70), (1, 9), (1, 1)):
        task = make(size)
        assert task.size == size
        assert task.shape == (*size, 3)
        assert task.render(np.full((2, task.dim), 0.3)).shape == (2, *size, 3)
    assert make((30, 70)).target.shape == (30, 70, 3)


def test_the_loss_is_lowest_at_x_star(make: Make) -> None:
    task = make()
    if task.x_star is None:
        pytest.skip("the target is not of this renderer")
    assert task.x_star.shape == (task.dim,)
    assert task.x_star.min() >= 0
    assert task.x_star.max() <= 1
    rng = np.random.default_rng(1)
    far = rng.random((40, task.dim))
    near = np.clip(task.x_star + rng.normal(0, 0.05, (40, task.dim)), 0, 1)
    assert loss(task.render(task.x_star[None]), task.target)[0] == 0
    assert loss(task.render(far), task.target).min() > 0
    assert loss(task.render(near), task.target).min() > 0


def test_x_star_does_not_depend_on_the_resolution(make: Make) -> None:
    one, other = make((60, 90)).x_star, make((20, 30)).x_star
    assert (one is None) == (other is None)
    if one is not None and other is not None:
        np.testing.assert_array_equal(one, other)


def test_seeds_give_different_targets(make: Make) -> None:
    targets = [make(seed=seed).target for seed in range(3)]
    for i, target in enumerate(targets):
        for other in targets[:i]:
            assert np.abs(target - other).mean() > 0.005


def test_renders_and_targets_are_reproducible(make: Make) -> None:
    X = np.random.default_rng(2).random((5, make().dim))
    np.testing.assert_array_equal(make().render(X), make().render(X))
    np.testing.assert_array_equal(make(seed=3).target, make(seed=3).target)


def test_global_random_state_is_neither_read_nor_changed(make: Make) -> None:
    np.random.seed(4)
    expected = np.random.random()
    np.random.seed(4)
    target = make(seed=7).target
    assert np.random.random() == expected
    np.random.seed(5)
    np.testing.assert_array_equal(make(seed=7).target, target)


def test_a_batch_equals_its_frames(task: Task) -> None:
    X = np.random.default_rng(3).random((7, task.dim))
    singles = np.concatenate([task.render(x[None], seed=[i]) for i, x in enumerate(X)])
    np.testing.assert_array_equal(task.render(X, seed=range(7)), singles)


def test_without_noise_the_reference_is_the_render(make: Make) -> None:
    task = make()
    x = np.random.default_rng(9).random(task.dim)
    np.testing.assert_array_equal(task.reference(x), task.render(x[None])[0])
    with pytest.raises(ValueError, match="x must be finite"):
        task.reference(np.full(task.dim, np.nan))


def test_an_empty_batch(task: Task) -> None:
    assert task.render(np.empty((0, task.dim))).shape == (0, *task.shape)


def test_outside_the_box_is_clipped(task: Task) -> None:
    x = np.random.default_rng(5).normal(0.5, 0.6, (3, task.dim))
    assert x.min() < 0
    assert x.max() > 1
    before = x.copy()
    np.testing.assert_array_equal(task.render(x, seed=1), task.render(np.clip(x, 0, 1), seed=1))
    np.testing.assert_array_equal(x, before)
    assert task.decode(x[0]) == task.decode(np.clip(x[0], 0, 1))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_not_finite_is_refused_with_its_place(task: Task, bad: float) -> None:
    X = np.full((3, task.dim), 0.5)
    X[2, 1] = bad
    with pytest.raises(ValueError, match=rf"x must be finite, but x\[2, 1\] is {bad}"):
        task.render(X)
    with pytest.raises(ValueError, match="x must be finite"):
        task.decode(X[2])


def test_wrong_shapes_are_refused(task: Task) -> None:
    n = task.dim
    with pytest.raises(ValueError, match=rf"\(n, {n}\), not \({n},\); .*pass x\[None\]"):
        task.render(np.zeros(n))
    with pytest.raises(ValueError, match=rf"\(n, {n}\), not \(4, {n + 1}\)"):
        task.render(np.zeros((4, n + 1)))
    with pytest.raises(ValueError, match=r"\(n, "):
        task.render(0.5)
    with pytest.raises(ValueError, match=rf"\(1, {n}\), not \(2, {n}\)"):
        task.decode(np.zeros((2, n)))


@pytest.mark.parametrize("dtype", [np.complex128, np.str_, object])
def test_wrong_types_are_refused(task: Task, dtype: Any) -> None:
    with pytest.raises(ValueError, match="x must be real numbers, not of dtype"):
        task.render(np.zeros((1, task.dim)).astype(dtype))


def test_exchanging_the_values_of_two_groups_leaves_the_image(make: Make) -> None:
    task = make()
    groups = task.groups
    if groups is None or len(groups) < 2:
        pytest.skip("nothing can be exchanged")
    indices = [index for group in groups for index in group]
    assert len(set(indices)) == len(indices), "groups are disjoint"
    assert set(indices) <= set(range(task.dim))
    assert len({len(group) for group in groups}) == 1
    rng = np.random.default_rng(10)
    for x in rng.random((5, task.dim)):
        one, other = rng.choice(len(groups), 2, replace=False)
        swapped = x.copy()
        swapped[groups[one]], swapped[groups[other]] = x[groups[other]], x[groups[one]]
        before, after = task.render(np.stack([x, swapped]))
        np.testing.assert_allclose(after, before, atol=2e-6)


def test_tasks_can_be_sent_to_other_processes(task: Task) -> None:
    copy = pickle.loads(pickle.dumps(task))
    X = np.random.default_rng(7).random((2, task.dim))
    np.testing.assert_array_equal(copy.render(X, seed=1), task.render(X, seed=1))
    np.testing.assert_array_equal(copy.target, task.target)


def test_a_picture_as_the_target(make: Make) -> None:
    picture = np.random.default_rng(8).random((20, 33, 3)).astype(np.float32)
    task = make(target=picture)
    assert task.size == (20, 33)
    assert task.x_star is None
    np.testing.assert_array_equal(task.target, picture)
    assert task.render(np.full((1, task.dim), 0.5)).shape == (1, 20, 33, 3)
    picture[:] = 0
    assert task.target.max() > 0, "the task must not share the caller's array"


@pytest.mark.parametrize(
    "picture",
    [
        np.zeros((8, 8), np.float32),
        np.zeros((8, 8, 4), np.float32),
        np.zeros((0, 8, 3), np.float32),
        np.zeros((8, 8, 3), np.uint8),
        np.full((8, 8, 3), np.nan, np.float32),
        np.full((8, 8, 3), 255.0, np.float32),
    ],
)
def test_bad_pictures_are_refused(make: Make, picture: NDArray[Any]) -> None:
    with pytest.raises(ValueError, match="a target picture must"):
        make(target=picture)


class Noise(Task):
    """A task of one parameter, its gray level, under noise."""

    name = "noise"
    stochastic = True
    parameters = (Parameter("light", "power", "W", 10.0, 30.0),)

    def _render(
        self, values: NDArray[np.float64], out: NDArray[np.float32], seeds: NDArray[np.uint32]
    ) -> None:
        for power, frame, seed in zip(values[:, 0], out, seeds, strict=True):
            noise = np.random.default_rng(seed).normal(0, 0.1, frame.shape)
            frame[:] = np.clip(power / 40 + noise, 0, 1)

    def _make_x_star(self) -> NDArray[np.float64]:
        return np.array([0.5])


X2 = np.array([[0.5], [0.5]])


def test_noise_is_fixed_by_the_seed_and_differs_between_frames() -> None:
    one, two = Noise(16).render(X2, seed=9)
    assert (one != two).mean() > 0.9
    np.testing.assert_array_equal(Noise(16).render(X2, seed=9), [one, two])
    np.testing.assert_array_equal(Noise(16).render(X2[:1], seed=9), [one])
    assert (Noise(16).render(X2[:1], seed=10)[0] != one).mean() > 0.9


def test_a_seed_for_each_frame_makes_frames_independent_of_their_batch() -> None:
    task = Noise(16)
    batch = task.render(X2, seed=[3, 9])
    np.testing.assert_array_equal(batch[1], task.render(X2[:1], seed=[9])[0])
    np.testing.assert_array_equal(batch[1], task.render(X2[:1], seed=9)[0])
    np.testing.assert_array_equal(task.render(X2, seed=np.array([3, 9])), batch)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="3 seeds for 2 candidates"):
        task.render(X2, seed=[1, 2, 3])
    with pytest.raises(ValueError, match="seed must be a whole number >= 0, not 1.5"):
        task.render(X2, seed=1.5)  # type: ignore[arg-type]


def test_without_a_seed_every_frame_has_its_own_noise() -> None:
    task = Noise(16)
    frames = np.concatenate([task.render(X2), task.render(X2), task.render(X2[:1])])
    for i in range(len(frames)):
        for j in range(i):
            assert (frames[i] != frames[j]).mean() > 0.9
    again = Noise(16)
    np.testing.assert_array_equal(again.render(np.repeat(X2[:1], 5, axis=0)), frames)


def test_the_reference_has_little_noise_and_is_always_the_same() -> None:
    image = Noise(48).reference([0.5])
    assert image.dtype == np.float32
    assert np.abs(image.mean() - 0.5) < 0.001
    assert image.std() == pytest.approx(0.1 / np.sqrt(64), rel=0.1)
    np.testing.assert_array_equal(Noise(48).reference([0.5]), image)
