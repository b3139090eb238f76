"""By eigenvalues and by the inverse the same comes out; what is said of left-out examples."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fide_plugins.proposers import feature_buffer as module
from fide_plugins.proposers.feature_buffer import ridge
from fide_plugins.types import Float64


def examples(n: int, features: int, d: int = 7) -> tuple[Float64, Float64]:
    rng = np.random.default_rng(n)
    e = rng.standard_normal((n, features)) * rng.uniform(0, 1, features) ** 4
    return e @ e.T, rng.standard_normal((n, d))


@pytest.mark.parametrize("features", [30, 900])
@pytest.mark.parametrize("penalty", [1e-3, 0.02, 1.0])
def test_the_inverse_gives_what_the_eigenvalues_give(
    features: int, penalty: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    gram, u = examples(300, features)
    by_inverse = ridge(gram, u, penalty, 1e-12)
    monkeypatch.setattr(module, "_SAFE", np.inf)
    by_eigenvalues = ridge(gram, u, penalty, 1e-12)
    for found, expected in zip(by_inverse, by_eigenvalues, strict=True):
        assert not np.array_equal(found, expected)  # two ways, indeed
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())


def test_a_penalty_that_is_nearly_nothing_needs_no_inverse(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gram, u = examples(250, 20)
    monkeypatch.setattr(torch, "cholesky_inverse", None)
    assert np.isfinite(ridge(gram, u, 1e-300, 1e-30).coefficients).all()


@pytest.mark.parametrize("n", [40, 230])
def test_residuals_over_one_minus_leverages_are_those_of_left_out_examples(n: int) -> None:
    """Each left out in turn and predicted by the others, with the same penalty."""
    gram, u = examples(n, 25)
    fit = ridge(gram, u, 0.02, 0.0)
    p = 0.02 * np.trace(gram) / min(n, 64)
    for i in range(0, n, 7):
        others = np.delete(np.arange(n), i)
        among = gram[np.ix_(others, others)] + p * np.eye(n - 1)
        predicted = gram[i, others] @ np.linalg.solve(among, u[others])
        left_out = fit.residuals[i] / (1 - fit.leverages[i])
        np.testing.assert_allclose(left_out, u[i] - predicted, rtol=1e-6, atol=1e-9)
