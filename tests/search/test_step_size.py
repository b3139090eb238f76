"""Two-point adaptation: the pair it asks for, and what it makes of the answer."""

from __future__ import annotations

import cma
import numpy as np
import pytest

from fide_plugins.search.cma_es import CMAES, TwoPoint
from fide_plugins.types import Float64

D, K = 100, 10  # many parameters, few candidates
PAIR = (0, 1)


def sphere(z: Float64) -> Float64:
    values: Float64 = np.square(z - 0.3).sum(axis=1)
    return values


def moved(search: CMAES, rng: np.random.Generator) -> Float64:
    """One generation; the step of the mean in units of sigma."""
    mean, sigma = search.mean, search.sigma
    z = search.sample(K, rng)
    search.tell(z, sphere(z), np.zeros(K, bool))
    step: Float64 = (search.mean - mean) / sigma
    return step


def test_the_first_two_samples_lie_along_and_against_the_last_step() -> None:
    search, rng = CMAES(np.full(D, 0.5), 1 / 6, K), np.random.default_rng(0)
    for _ in range(3):
        step = moved(search, rng)
    y = (search.sample(K, rng) - search.mean) / search.sigma
    np.testing.assert_allclose(y[0], -y[1], rtol=1e-12)
    cosine = y[0] @ step / (np.linalg.norm(y[0]) * np.linalg.norm(step))
    assert cosine == pytest.approx(1)
    assert abs(y[2] @ step) < 0.9 * np.linalg.norm(y[2]) * np.linalg.norm(step)
    lengths = np.linalg.norm((y @ search._B) / search._D, axis=1)  # as long as any other sample
    assert abs(lengths[0] - np.sqrt(D)) < 4
    assert abs(lengths[2:].mean() - np.sqrt(D)) < 2


@pytest.mark.parametrize("ahead_rank", [0, 4, K - 1])
@pytest.mark.parametrize("against_rank", [1, 5, K - 2])
def test_the_factor_is_that_of_the_library(ahead_rank: int, against_rank: int) -> None:
    """`cma`'s two-point adaptation, told the same ranks again and again."""
    options = {"AdaptSigma": cma.sigma_adaptation.CMAAdaptSigmaTPA, "verbose": -9, "popsize": K}
    es = cma.CMAEvolutionStrategy(D * [0.5], 1 / 6, {**options, "seed": np.nan})
    two = TwoPoint(D)
    losses = np.empty(K)
    others = [rank for rank in range(K) if rank not in (ahead_rank, against_rank)]
    losses[[0, 1]] = ahead_rank, against_rank
    losses[2:] = others
    assert two.factor(np.ones(D), losses, PAIR) == 1.0  # no pair yet
    for _ in range(3):
        expected = es.adapt_sigma.update2(es, losses)
        assert two.factor(np.ones(D), losses, PAIR) == pytest.approx(expected, rel=1e-12)


def test_the_step_size_follows_in_both_directions() -> None:
    """Far too wide at an optimum it falls by half, far too narrow on a slope it doubles."""
    rng = np.random.default_rng(0)
    wide = CMAES(np.full(D, 0.31), 0.5, K)
    narrow = CMAES(np.full(D, 0.5), 1e-4, K, widest=np.inf)
    for _ in range(60):
        for search in (wide, narrow):
            moved(search, rng)
    assert wide.sigma < 0.25
    assert narrow.sigma > 2e-4
