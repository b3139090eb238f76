"""Which pictures are like the renders that were learned."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fide_plugins.learning import Model
from fide_plugins.learning.judging import Familiarity
from fide_plugins.types import Float64


def features(rng: np.random.Generator, n: int, spread: float = 0.2) -> Float64:
    """Of n renders (n, 30), some of them further away than normal ones would be."""
    z = rng.standard_normal((n, 30)) * np.linspace(1, 0.05, 30)
    return np.asarray(z * np.exp(spread * rng.standard_normal((n, 1))), np.float64)


@pytest.mark.parametrize("held_out", [2, 3, 5, 10, 20, 100])
def test_further_renders_are_familiar_however_few_were_held_out(held_out: int) -> None:
    """And other pictures are not: two of a hundred are the fewest that `learn` holds out."""
    unknown, known = [], []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        familiarity = Familiarity.of(features(rng, 49 * held_out), features(rng, held_out))
        unknown.append((familiarity.distances(features(rng, 100)) > familiarity.threshold).mean())
        others = features(rng, 100) + 1.0
        known.append((familiarity.distances(others) <= familiarity.threshold).mean())
    assert np.mean(unknown) < 0.005  # by the largest of ten alone, 0.017
    # by the held-out renders alone, 0.9 with two, 0.2 with five; of two a single fit may know all
    assert np.mean(known) < (0.05 if held_out == 2 else 0.005)


@pytest.mark.parametrize("held_out", [1, 2, 3])
def test_the_bound_is_finite_for_the_least_held_out_renders(held_out: int) -> None:
    rng = np.random.default_rng(0)
    same = np.full((4, 3), 0.5)
    for renders in (features(rng, held_out), np.zeros((held_out, 30))):
        assert np.isfinite(Familiarity.of(features(rng, 40), renders).threshold)
    familiarity = Familiarity.of(same, same[:held_out])
    assert familiarity.knows(same[0]) and not familiarity.knows(same[0] + 0.1)


@pytest.mark.parametrize(("far", "shown"), [(2.047, "2.05 times"), (7.57e299, "7.57e+299 times")])
def test_how_unlike_a_picture_is_has_three_digits(far: float, shown: str) -> None:
    """Of renders that are all equal every other picture is any number of times too far."""
    model: Any = SimpleNamespace(renderer="scene")
    assert f"its features are {shown} as far" in Model.unlike_all(model, far)
