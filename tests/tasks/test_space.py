"""Every task's parameters as a space: the same values as its own decoding."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fide_plugins import Float, Group, Space
from fide_tasks.base import Image, Parameter, Task, Vector
from fide_tasks.beads import Beads
from fide_tasks.lens import Lens
from fide_tasks.named import space_of
from fide_tasks.san_miguel import SanMiguel
from fide_tasks.spline import Spline
from fide_tasks.voronoi import Voronoi


def leaves(params: Any) -> list[float]:
    if isinstance(params, float):
        return [params]
    inner = params.values() if isinstance(params, dict) else params
    return [value for each in inner for value in leaves(each)]


class Arm(Task):
    """Joints that are not alike."""

    parameters = (
        Parameter("joint 1", "angle", "rad", -2.9, 2.9),
        Parameter("joint 2", "angle", "rad", -1.8, 1.8),
    )

    def _render(self, values: Vector, out: Image, seeds: object) -> None:
        raise NotImplementedError


TASKS = [Voronoi(16, cells=5), Voronoi(16, variant="distance"), Spline(16), Arm(8), Lens(16)]


@pytest.mark.parametrize("task", TASKS, ids=lambda task: type(task).__name__)
def test_values_are_those_of_decode(task: Task) -> None:
    rng = np.random.default_rng(0)
    for x in rng.random((20, task.dim)):
        own = leaves(task.decode(x))
        assert leaves(task.space.decode(x)) == own
        np.testing.assert_allclose(task.space.encode(task.space.decode(x)), x, atol=1e-12)
    assert task.space.dim == task.dim


@pytest.mark.parametrize("task", [Beads, SanMiguel])
def test_values_of_tasks_that_need_a_renderer(task: type[Task]) -> None:
    low = np.array([p.low for p in task.parameters])
    high = np.array([p.high for p in task.parameters])
    space = space_of(task.parameters, task.alike)
    for x in np.random.default_rng(1).random((20, len(low))):
        assert leaves(space.decode(x)) == (low + x * (high - low)).tolist()


def test_names_units_and_what_may_change_places() -> None:
    voronoi = Voronoi(16, cells=2).space
    assert voronoi.names[:3] == ["cells[0].x", "cells[0].y", "cells[0].red"]
    assert voronoi.groups == [[0, 1, 2, 3, 4], [5, 6, 7, 8, 9]]
    spline = Spline(16, control_points=2).space
    assert spline.names == ["point_1.x", "point_1.y", "point_2.x", "point_2.y", "stroke.thickness"]
    assert spline.groups == []  # another order of the points is another stroke
    beads = space_of(Beads.parameters, Beads.alike)
    assert len(beads.groups) == 6 and beads.parameters["beads[0].x"].unit == "half sides"
    camera = space_of(SanMiguel.parameters, SanMiguel.alike)
    np.testing.assert_array_equal(np.flatnonzero(camera.periodic), [4])
    assert Arm(8).space == Space(
        joint_1=Group(angle=Float(-2.9, 2.9, unit="rad")),
        joint_2=Group(angle=Float(-1.8, 1.8, unit="rad")),
    )
