"""What a target shows where a mask hides it has no influence on the run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import FIDE, losses
from fide_plugins.losses.base import LossOfTarget
from fide_plugins.losses.perceptual import PerceptualLoss
from fide_plugins.types import Float32, Float64
from fide_plugins.views import Views

Render = Callable[[Float64], Float32]
MASK = np.ones((16, 16), np.float32)
MASK[:, 9:] = 0
SOFT = MASK.copy()
SOFT[:4] *= 0.2


def other_where(hidden: Any, picture: Float32, seed: int = 0) -> Float32:
    """The picture with noise where it is hidden."""
    noise = np.random.default_rng(seed).random(picture.shape, np.float32)
    return np.where(hidden[..., None], noise, picture)


def run(opt: FIDE, images_of: Callable[[Float64], Any], generations: int) -> tuple[Float64, ...]:
    """All candidates and losses."""
    asked, told = [], []
    for _ in range(generations):
        asked.append(opt.ask())
        told.append(opt.tell(asked[-1], images_of(asked[-1])))
    return np.concatenate(asked), np.concatenate(told)


@pytest.mark.parametrize("loss", ["mse", "perceptual", "loi"])
@pytest.mark.parametrize("mask", [MASK, SOFT], ids=["hard", "soft"])
def test_the_run_is_the_same(mask: Float32, loss: str, render: Render, target: Float32) -> None:
    targets = target, other_where(mask == 0, target)
    one, other = (
        run(FIDE(6, each, mask=mask, loss=loss, seed=0, popsize=8), render, 6) for each in targets
    )
    for here, there in zip(one, other, strict=True):
        np.testing.assert_array_equal(here, there)


def test_hidden_pixels_have_the_color_of_what_counts(target: Float32) -> None:
    view = Views.read(target, SOFT).views[0]
    mean = target[:, :9].mean(axis=(0, 1))
    assert np.abs(view.filled[:, 9:] - mean).max() <= 1 / 16 + 1e-6
    assert (view.filled[:, 9:] == view.filled[0, 9]).all()
    np.testing.assert_array_equal(view.filled[:, :9], target[:, :9])
    np.testing.assert_array_equal(view.target, target)
    for whole in (None, np.where(MASK == 0, 0.5, 1.0)):
        view = Views.read(target, whole).views[0]
        assert view.filled is view.target


def test_a_users_own_loss_gets_the_targets_own_pixels(render: Render, target: Float32) -> None:
    """It may have been made for them, so they must cost nothing."""
    images = render(np.random.default_rng(0).random((3, 6)))
    right = np.where(MASK[..., None] > 0, target, images)

    def distance(batch: Float32) -> Float64:
        values: Float64 = np.square(batch - target).mean(axis=(1, 2, 3), dtype=np.float64)
        return values

    for loss in (distance, PerceptualLoss(target), losses.make("perceptual", target)):
        assert FIDE(6, target, mask=MASK, loss=loss).evaluator.loss(right).tolist() == [0, 0, 0]


def check_that_it_goes_on(opt: FIDE, render: Render, folder: Path) -> None:
    """From a checkpoint after two generations, with the same candidates and losses."""
    run(opt, render, 2)
    opt.save(folder / "c")
    again = FIDE.load(folder / "c")
    for here, there in zip(run(opt, render, 3), run(again, render, 3), strict=True):
        np.testing.assert_array_equal(here, there)


class Absolute(LossOfTarget):
    """Mean absolute difference, weighed by itself."""

    name, version = "absolute-of-tests", "absolute-of-tests-1"
    weighs_pixels = True

    def __init__(self, target: Float32, weights: Float32 | None = None) -> None:
        super().__init__(target)
        self.weights = np.ones(target.shape[:2], np.float32) if weights is None else weights

    def _distance(self, image: Float32) -> float:
        apart = np.abs(image - self.target).mean(axis=2, dtype=np.float64)
        return float((apart * self.weights).sum() / self.weights.sum())


@pytest.mark.parametrize("weights", [MASK, SOFT, np.maximum(SOFT, 0.1)])
def test_a_made_loss_that_weighs_pixels_goes_on_from_a_checkpoint(
    weights: Float32,
    render: Render,
    target: Float32,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(losses._REGISTRY._factories, "absolute-of-tests", Absolute)
    made = losses.make("absolute-of-tests", target)
    opt = FIDE(6, target, weights=weights, loss=made, seed=0, popsize=8)
    check_that_it_goes_on(opt, render, tmp_path)
