"""Robot: kinematics by the published numbers, targets worth finding, what images show."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fide_tasks import panda
from fide_tasks.robot import Robot

pytestmark = pytest.mark.usefixtures("opengl")


@pytest.fixture(scope="module")
def task() -> Robot:
    return Robot(64)


def random_x(n: int, seed: int = 0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).random((n, 7))


def test_links_are_where_the_product_of_denavit_and_hartenberg_puts_them(task: Robot) -> None:
    import mujoco

    model: Any = task._model
    data: Any = mujoco.MjData(model)
    links = [model.body(f"link{i + 1}").id for i in range(7)]
    low, width = task._range
    for x in [*random_x(100), np.zeros(7), np.ones(7)]:
        task._pose(data, low + x * width)
        expected = panda.frames(low + x * width)[:7]
        turns = data.xmat[links].reshape(-1, 3, 3)
        np.testing.assert_allclose(turns, expected[:, :3, :3], rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.xpos[links], expected[:, :3, 3], rtol=0, atol=1e-9)


def test_every_joint_can_be_seen(task: Robot) -> None:
    x = task.x_star
    assert x is not None
    for joint in range(7):
        moved = x.copy()
        moved[joint] += 0.1 if x[joint] < 0.5 else -0.1
        assert np.abs(task.render(moved[None])[0] - task.target).mean() > 1e-4, f"{joint=}"


def test_the_image_varies_continuously() -> None:
    """The change is as small as the step, down to the steps of pixels."""
    task = Robot(112)
    X = np.random.default_rng(3).uniform(0.1, 0.9, (20, 7))
    away = np.random.default_rng(4).choice([-1.0, 1.0], X.shape)
    images, changes = task.render(X), []
    for step in (1e-3, 1e-4, 1e-5, 1e-12):
        changes.append(float(np.abs(task.render(X + step * away) - images).mean()))
    assert changes[0] < 2e-3
    assert changes[1] < 0.2 * changes[0]
    assert changes[2] < 0.2 * changes[1]
    assert changes[3] < 1e-6


def test_targets_are_seen_whole_and_over_the_floor(task: Robot) -> None:
    """What the criterion says of its capsules holds for the shapes that are drawn."""
    import mujoco

    model: Any = task._model
    margin = np.ones((64, 64), bool)
    margin[1:-1, 1:-1] = False
    background = np.median(task.render(random_x(200)), axis=0)
    for seed in range(30):
        one = Robot(64, seed)
        assert one.x_star is not None
        shown = task.render(one.x_star[None])[0]
        changed = np.abs(shown - background).max(axis=2) > 0.1
        assert not (changed & margin).any(), f"cut by the border at {seed=}"
        data: Any = mujoco.MjData(model)
        task._pose(data, one._one(one.x_star))
        moving = np.flatnonzero(model.geom_bodyid > model.body("link1").id)
        height = data.geom_xpos[moving, 2] - model.geom_rbound[moving]
        assert height.min() > -0.06, f"in the floor at {seed=}"


@pytest.mark.parametrize(
    ("angles", "why"),
    [
        ((0, -0.5, 0, -1.5, 0, 1.6, 0.8), None),
        ((0, 1.7, 0, -0.1, 0, 1.8, 0.8), "in the floor"),
        ((0, 0.9, 0, -3.0, 0, 0.2, 0.8), "folded into itself"),
        ((0, 0.4, 0, -3.0, 0, 0.0, 0.0), "the hand in the upper arm"),
    ],
)
def test_poses_that_are_not_possible_are_no_targets(
    angles: tuple[float, ...], why: str | None
) -> None:
    links = panda._links(np.array(angles))
    assert panda._is_free(links) == (why is None)
