"""A user's own loss: tried when it is passed, and registered by name."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import FIDE, losses
from fide_plugins.errors import LossError
from fide_plugins.losses.base import MeanSquaredError
from fide_plugins.types import Float32

Loss = Callable[[Any], Any]


def l1(target: Float32) -> Loss:
    return lambda images: np.abs(images - target).mean(axis=(1, 2, 3), dtype=np.float64)


def test_a_sound_loss_is_used_as_it_is(render: Any, target: Float32) -> None:
    opt = FIDE(6, target, loss=l1(target), popsize=8, seed=0)
    X = opt.ask()
    opt.tell(X, render(X))
    assert opt.best is not None
    assert opt.best.loss == l1(target)(render(X)).min()


@pytest.mark.parametrize(
    ("loss", "message"),
    [
        (lambda images: images.mean(), "must be 2 numbers, one per image"),
        (lambda images: np.zeros((len(images), 3)), "must be 2 numbers, one per image"),
        (lambda images: ["low"] * len(images), "must be real numbers"),
        (lambda images: [images.mean()] * len(images), "same values in every batch"),
        (lambda images: images.mean(axis=(1, 2, 3)) / len(images), "same values in every batch"),
        (lambda images: images.mean(axis=(1, 2, 3)) * np.nan, "finite for the target itself"),
        (lambda images: images["front"], r"tried on two images.*\(2, 16, 16, 3\).*IndexError"),
    ],
)
def test_a_wrong_loss_is_refused_before_the_first_render(
    loss: Loss, message: str, target: Float32
) -> None:
    with pytest.raises(LossError, match=f"(?s){message}"):
        FIDE(6, target, loss=loss)


@pytest.fixture
def registered() -> Iterator[str]:
    losses.register("l1-of-tests", l1)
    yield "l1-of-tests"
    del losses._REGISTRY._factories["l1-of-tests"]


def test_a_registered_loss_is_saved_by_name(
    registered: str, render: Any, target: Float32, tmp_path: Path
) -> None:
    assert registered in losses.names()
    opt = FIDE(6, target, loss=registered, popsize=8, seed=0)
    X = opt.ask()
    opt.tell(X, render(X))
    opt.save(tmp_path / "c")
    copy = FIDE.load(tmp_path / "c")
    np.testing.assert_array_equal(copy.evaluator.loss(render(X)), l1(target)(render(X)))
    masked = FIDE(6, [target, target], mask=[None, np.eye(16, dtype=np.float32)], loss=registered)
    assert masked.evaluator.loss.spec == registered


def test_a_loss_may_weigh_pixels_itself(registered: str, target: Float32) -> None:
    class Weighted(MeanSquaredError):
        """An own class that takes weights as `mse` does."""

    losses.register(registered, Weighted)
    assert losses.takes_weights(registered) and losses.takes_weights("mse")
    mask = np.eye(16, dtype=np.float32)
    own, mse = (FIDE(6, target, mask=mask, loss=loss) for loss in (registered, "mse"))
    images = np.stack([target, 1 - target])
    np.testing.assert_array_equal(own.evaluator.loss(images), mse.evaluator.loss(images))
