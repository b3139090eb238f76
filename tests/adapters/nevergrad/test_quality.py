"""Acceptance point 25 in full length: no worse than CMA-ES, whatever the images say."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import fide_tasks
from fide_adapters.nevergrad import ImageLoss

from .conftest import box, fide

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::fide_adapters.nevergrad.NoImagesWarning"),
]

MARGIN = 1.1  # ratio of the geometric means of losses, see docs/reference/nevergrad.md


PICTURES: dict[str, Callable[[Any, np.random.Generator], Any]] = {
    "none": lambda image, rng: None,
    "true": lambda image, rng: image,
    "constant": lambda image, rng: np.full(image.shape, 0.5, np.float32),
    "noise": lambda image, rng: rng.random(image.shape, dtype=np.float32),
}


def best_loss(kind: str, seed: int) -> float:
    task, rng = fide_tasks.make("voronoi", size=32, seed=seed), np.random.default_rng(seed)

    def objective(x: Any) -> ImageLoss:
        image = task.render(x[None])[0]
        return ImageLoss(float(((image - task.target) ** 2).mean()), PICTURES[kind](image, rng))

    optimizer = fide(box(task.dim), 1200, target=task.target, seed=seed)
    return float(optimizer.minimize(objective).loss)


def test_point_25_images_that_say_nothing_do_no_harm_and_others_help() -> None:
    logs = {kind: np.log([best_loss(kind, seed) for seed in range(4)]) for kind in PICTURES}
    ratio = {kind: float(np.exp((log - logs["none"]).mean())) for kind, log in logs.items()}
    assert ratio["constant"] < MARGIN and ratio["noise"] < MARGIN
    assert ratio["true"] < 0.8
