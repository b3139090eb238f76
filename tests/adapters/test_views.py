"""Views and masks are the same in the core, in Nevergrad, in Optuna and in replicas."""

from __future__ import annotations

from typing import Any

import nevergrad as ng
import numpy as np

from fide_adapters.image_loss import is_image
from fide_adapters.nevergrad import ParametrizedFIDE
from fide_plugins import FIDE
from fide_plugins.types import Float32

DIM = 4
MASK = np.ones((10, 14), np.float32)
MASK[:, :4] = 0


def views(x: Any) -> list[Float32]:
    """A soft disk at x[0:2] of brightness x[2], and its profile of brightness x[3]."""
    rows, columns = (np.arange(12) + 0.5) / 12, (np.arange(14) + 0.5) / 14
    front = np.exp(-20 * ((rows[:, None] - x[0]) ** 2 + (rows - x[1]) ** 2)) * x[2]
    side = np.exp(-20 * np.square(columns - x[0]))[None].repeat(10, 0) * x[3]
    return [np.dstack([image] * 3).astype(np.float32) for image in (front, side)]


TARGETS = views([0.7, 0.4, 0.9, 0.6])
SETTINGS: dict[str, Any] = {"mask": [None, MASK], "seed": 0, "popsize": 6}


def core() -> FIDE:
    return FIDE(DIM, TARGETS, **SETTINGS)


def test_targets_and_masks_are_settings() -> None:
    same = ParametrizedFIDE(target=TARGETS, mask=[None, MASK])
    assert same == ParametrizedFIDE(target=TARGETS, mask=[None, MASK])
    assert same != ParametrizedFIDE(target=TARGETS)
    ranges = [ParametrizedFIDE(target=TARGETS, value_range=(0, high)) for high in (2, 4)]
    assert ranges[0] != ranges[1]
    optimizer: Any = ParametrizedFIDE()(ng.p.Array(shape=(DIM,), lower=0, upper=1))
    optimizer.target = TARGETS
    assert len(optimizer.target) == 2


def test_a_list_of_images_is_an_image_and_a_list_of_losses_is_none() -> None:
    assert is_image(TARGETS) and is_image(tuple(TARGETS))
    assert not is_image([0.1, 0.2]) and not is_image([]) and not is_image((0.1, TARGETS[0]))
