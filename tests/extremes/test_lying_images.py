"""Images that lie: the search is the one without images, bit for bit, or nearly as good."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64

DIM, SIZE = 5, 8
TARGET = np.random.default_rng(5).random((SIZE, SIZE, 3), np.float32)
Images = Callable[[Float64, np.random.Generator], Float32 | None]


def render(X: Float64) -> Float32:
    weights = np.random.default_rng(3).standard_normal((DIM, TARGET.size))
    images: Float32 = (1 / (1 + np.exp((0.5 - X) @ weights))).astype(np.float32)
    return images.reshape(len(X), *TARGET.shape)


LIES: dict[str, Images] = {
    "none": lambda X, rng: None,
    "noise": lambda X, rng: rng.random((len(X), *TARGET.shape), np.float32),
    "constant": lambda X, rng: np.full((len(X), *TARGET.shape), 0.3, np.float32),
    "of other candidates": lambda X, rng: render(rng.random(X.shape)),
}


def sphere(X: Float64) -> Float64:
    losses: Float64 = np.square(X - 0.3).sum(axis=1)
    return losses


def rosenbrock(X: Float64) -> Float64:
    u = 4 * X - 2
    losses: Float64 = (
        100 * (u[:, 1:] - u[:, :-1] ** 2) ** 2 + (1 - u[:, :-1]) ** 2
    ).sum(axis=1)  # fmt: skip
    return losses


def run(what: str, loss: Callable[[Float64], Float64], budget: int, seed: int) -> list[Float64]:
    opt, rng = FIDE(DIM, TARGET, seed=seed), np.random.default_rng(seed)
    asked = []
    while opt.evaluations < budget:
        X = opt.ask()
        opt.tell(X, LIES[what](X, rng), loss(X))
        asked.append(X)
    return asked


@pytest.mark.parametrize("loss", [sphere, rosenbrock])
@pytest.mark.parametrize("lie", ["noise", "constant", "of other candidates"])
def test_what_is_asked_is_what_would_be_asked_without(
    lie: str, loss: Callable[[Float64], Float64]
) -> None:
    without = np.concatenate(run("none", loss, 300, seed=0))
    np.testing.assert_array_equal(np.concatenate(run(lie, loss, 300, seed=0)), without)


def test_the_picture_of_something_else_ends_no_search() -> None:
    """One of its sides is nearer, too: images agree some, and a search that stalls goes on."""
    weights = 2 * np.random.default_rng(3).standard_normal((10, 32 * 32 * 3))
    other = np.random.default_rng(5).random((32, 32, 3), np.float32)
    opt = FIDE(10, other, seed=2)
    while opt.evaluations < 800:
        X = opt.ask()
        images = (1 / (1 + np.exp((0.5 - X) @ weights))).reshape(-1, 32, 32, 3)
        opt.tell(X, images, rosenbrock(X))
    assert opt.state.searches == 1


def test_without_images_a_search_converges_to_the_last_digits() -> None:
    """A patience of ten generations, and an end at a thousandth of the box, are for images."""
    X = np.concatenate(run("none", sphere, 1200, seed=0))
    assert sphere(X).min() < 1e-14
    X = np.concatenate(run("none", rosenbrock, 2500, seed=0))
    assert rosenbrock(X).min() < 1e-8
