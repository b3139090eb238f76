"""Exchangeable blocks: no order of them is learned, and none is needed."""

from __future__ import annotations

import numpy as np
import pytest

import fide_tasks
from fide_plugins.learning import learn


@pytest.mark.slow
def test_cells_are_found_in_any_order() -> None:
    task = fide_tasks.make("voronoi", 16, cells=2)
    model = learn(task, renders=2000, size=16, passes=4)
    assert model.head == "set"
    assert model.report.nll < -1
    assert all(np.isnan(model.report.ranks))
    x = task.x_star
    assert x is not None
    swapped = np.roll(x, 5)
    p, q = model.log_prob(task.target, [x, swapped])
    np.testing.assert_allclose(p, q, rtol=1e-5)
    assert model.distance(swapped[None], x)[0] == 0
