"""Acceptance points 4 and 21: the same as FIDE alone, and the same again."""

from __future__ import annotations

import random
import warnings
from typing import Any

import nevergrad as ng
import numpy as np
import pytest
import torch

from fide_adapters.nevergrad import NoImagesWarning
from fide_plugins.fide import FIDE
from fide_plugins.points import Float64

from .conftest import TARGET, box, fide, mse, render, told


@pytest.mark.parametrize("settings", [{}, {"preset": "fast", "popsize": 12}])
def test_point_4_the_same_candidates_as_fide_alone(settings: dict[str, Any]) -> None:
    optimizer, alone = fide(**settings), FIDE(6, TARGET, seed=0, **settings)
    for _ in range(150):
        candidate, X = optimizer.ask(), alone.ask(1)
        np.testing.assert_allclose(candidate.value, X[0], atol=1e-12)
        optimizer.tell(candidate, render(candidate.value))
        alone.tell(X, [render(X[0])])
    assert alone.best is not None and alone.best.loss < 1e-3
    assert optimizer.recommend().loss == pytest.approx(alone.best.loss, rel=1e-6)


def test_point_4_losses_computed_here_or_there_are_the_same() -> None:
    one, other = fide(), fide()
    for _ in range(60):
        a, b = one.ask(), other.ask()
        np.testing.assert_array_equal(a.value, b.value)
        image = render(a.value)
        one.tell(a, image)
        other.tell(b, mse(image), image=image)
        assert a.loss == pytest.approx(b.loss, rel=1e-12)


def test_point_4_without_images_it_is_cma_es() -> None:
    """With a target or without, and with an image that has nothing to be compared with."""
    alone = FIDE(6, TARGET, seed=0, proposer="none")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NoImagesWarning)
        others = [fide(), fide(target=None), fide(target=None)]
        for _ in range(150):
            X = alone.ask(1)
            candidates = [optimizer.ask() for optimizer in others]
            for candidate in candidates:
                np.testing.assert_allclose(candidate.value, X[0], atol=1e-12)
            image = render(X[0])
            alone.tell(X, losses=[mse(image)])
            others[0].tell(candidates[0], mse(image))
            others[1].tell(candidates[1], mse(image))
            others[2].tell(candidates[2], mse(image), image=image)
    assert alone._search.generation >= 3


def test_without_a_target_it_says_so_once() -> None:
    optimizer = fide(target=None)
    with pytest.warns(NoImagesWarning, match=r"no target.*CMA-ES") as record:
        for _ in range(30):
            candidate = optimizer.ask()
            optimizer.tell(candidate, 1.0)
    assert len(record) == 1


def test_without_images_it_says_so_once_after_a_generation() -> None:
    optimizer = fide()
    for _ in range(8):
        optimizer.tell(optimizer.ask(), 1.0)
    with pytest.warns(NoImagesWarning, match=r"no images.*ImageLoss"):
        optimizer.tell(optimizer.ask(), 1.0)
    for _ in range(20):
        optimizer.tell(optimizer.ask(), 1.0)


def test_a_few_losses_without_images_are_no_reason_to_warn() -> None:
    optimizer = fide()
    told(optimizer, 1)
    for _ in range(20):
        optimizer.tell(optimizer.ask(), 1.0)


def run(seed: int, parametrization: Any) -> list[Float64]:
    optimizer = fide(parametrization, seed=None)
    optimizer.parametrization.random_state.seed(seed)
    return told(optimizer, 40)


def test_point_21_the_random_state_of_the_parametrization_is_the_seed() -> None:
    first, again, other = run(5, box()), run(5, box()), run(6, box())
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[0], other[0])
    seeded = box()
    seeded.random_state.seed(5)
    optimizer = fide(seeded, seed=None)
    np.testing.assert_array_equal(told(optimizer, 40), first)


def test_point_21_choices_are_reproducible_too() -> None:
    def values(seed: int) -> list[Any]:
        parametrization = ng.p.Tuple(ng.p.Choice(list("abcd")), ng.p.Scalar(lower=0, upper=1))
        optimizer = fide(parametrization, seed=None)
        parametrization.random_state.seed(seed)
        found = []
        for _ in range(30):
            candidate = optimizer.ask()
            optimizer.tell(candidate, render(np.full(6, candidate.value[1])))
            found.append(candidate.value)
        return found

    assert values(3) == values(3) != values(4)


def test_point_21_global_random_state_is_left_alone() -> None:
    optimizer = fide(seed=None)
    optimizer.parametrization.random_state.seed(1)
    np.random.seed(7)
    torch.manual_seed(7)
    random.seed(7)
    told(optimizer, 40)
    drawn = np.random.random(), torch.rand(1).item(), random.random()
    np.random.seed(7)
    torch.manual_seed(7)
    random.seed(7)
    assert drawn == (np.random.random(), torch.rand(1).item(), random.random())


def test_an_off_center_beginning_is_respected() -> None:
    parametrization = ng.p.Array(init=[0.2, 0.8]).set_mutation(sigma=0.02).set_bounds(0, 1)
    optimizer = fide(parametrization, popsize=1000)
    X = np.array([optimizer.ask().value for _ in range(1000)])
    np.testing.assert_allclose(X.mean(axis=0), [0.2, 0.8], atol=0.005)
    np.testing.assert_allclose(X.std(axis=0), 0.02, rtol=0.1)
