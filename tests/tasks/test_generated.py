"""Generated targets: every parameter shows, and what is drawn again until it does."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

import fide_tasks
from fide_tasks import Parameter
from fide_tasks.generated import GeneratedTask

ELSEWHERE = (*fide_tasks.names(), *fide_tasks.names("many"))  # targets are not drawn: a photograph
OWN = [name for name in fide_tasks.names("all") if name not in ELSEWHERE]
Array = NDArray[np.float64]


@pytest.mark.parametrize("name", OWN)
def test_every_parameter_of_three_targets_shows(name: str) -> None:
    """A step of 0.02 by the stated rule, and central differences of 0.001: there is no plateau."""
    for seed in range(3):
        task = cast(GeneratedTask, fide_tasks.make(name, 64, seed))
        x = task.x_star
        assert x is not None
        toward = np.where(x < 0.5, 0.02, -0.02)
        images = task.render(np.vstack([x, x + np.diag(toward)])).astype(np.float64)
        change = np.abs(images[1:] - images[0]).mean(axis=(1, 2, 3))
        assert change.min() >= task.least_change, task.parameters[int(change.argmin())]
        step = 1e-3 * np.eye(task.dim)
        slope = (task.render(x + step).astype(np.float64) - task.render(x - step)) / 2e-3
        assert np.abs(slope).mean(axis=(1, 2, 3)).min() > 2e-4


@pytest.mark.parametrize("name", OWN)
def test_sizes_show_the_same_picture(name: str) -> None:
    large, small = fide_tasks.make(name, 224).target, fide_tasks.make(name, 56).target
    averaged = large.reshape(56, 4, 56, 4, 3).mean(axis=(1, 3))
    assert np.abs(averaged - small).mean() < 0.012


class Switches(GeneratedTask):
    """Each parameter lights a column of its own where it is above one half."""

    name = "switches"
    parameters = tuple(Parameter("switch", str(i), "1", 0.0, 1.0) for i in range(4))
    grouped = True
    draws = 0

    @property
    def groups(self) -> list[list[int]] | None:
        return [[0], [1], [2]] if self.grouped else None

    def _render(self, values: Array, out: NDArray[np.float32], seeds: NDArray[np.uint32]) -> None:
        out[:] = 0
        out[:, :, :4] = np.maximum(values - 0.5, 0)[:, None, :, None]

    def _draw(self, rng: np.random.Generator) -> Array:
        self.draws += 1
        return rng.random(4)


def test_targets_are_drawn_until_all_is_visible() -> None:
    for seed in range(10):
        x = Switches(8, seed).x_star
        assert x is not None
        assert (x > 0.5).all()


def test_the_best_of_many_is_taken_where_none_is_good() -> None:
    class Hopeless(Switches):
        least_change = 1.0

    task = Hopeless(8)
    assert task.x_star is not None
    assert task.draws == 201
