"""The search distribution: the numbers of `cmaes`, and what injected candidates may do to it."""

from __future__ import annotations

import copy
from copy import deepcopy
from typing import Any

import cmaes
import numpy as np
import numpy.typing as npt
import pytest

from fide_plugins.search.cma_es import CMAES, default_popsize
from fide_plugins.types import Float64


def ellipsoid(z: Float64) -> Float64:
    """Condition 1e4, and no eigenvector along an axis."""
    d = z.shape[1]
    rotation = np.linalg.qr(np.random.default_rng(5).standard_normal((d, d)))[0]
    values: Float64 = (((z - 0.3) @ rotation) ** 2 * np.geomspace(1, 1e4, d)).sum(axis=1)
    return values


def own(n: int) -> npt.NDArray[np.bool_]:
    return np.zeros(n, bool)


def check_sane(search: CMAES) -> None:
    assert np.isfinite(search.mean).all() and np.isfinite(search.sigma) and search.sigma > 0
    np.testing.assert_array_equal(search.C, search.C.T)
    assert np.linalg.eigvalsh(search.C)[0] > 0
    z = search.sample(5, np.random.default_rng(0))
    assert np.isfinite(z).all()
    assert np.isfinite(search.std).all() and search.std.min() > 0


@pytest.mark.parametrize(
    ("d", "k"), [(1, 4), (1, 5), (2, 6), (2, 7), (5, 30), (10, 10), (40, 15), (40, 16), (3, 200)]
)
def test_numbers_are_those_of_the_library(d: int, k: int) -> None:
    """Told the same candidates, generation after generation."""
    ours = CMAES(np.full(d, 0.6), 0.3, k, widest=np.inf)
    theirs = cmaes.CMA(np.full(d, 0.6), 0.3, population_size=k)
    rng = np.random.default_rng(d + k)
    checked = 0
    while checked < 50:
        z = ours.sample(k, rng)
        losses = ellipsoid(z)
        ours.tell(z, losses, own(k))
        theirs.tell([(z[i].copy(), float(losses[i])) for i in range(k)])
        if ours.std.max() < 1e-9:  # rounding is no longer small
            break
        np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-9, atol=1e-9 * ours.std.max())
        sigma2_c = ours.sigma**2 * ours.C
        reference = theirs._sigma**2 * theirs._C
        np.testing.assert_allclose(sigma2_c, reference, rtol=1e-7, atol=1e-8 * reference.max())
        checked += 1
    assert checked >= 30


def test_samples_have_the_distribution_s_mean_and_covariance() -> None:
    search = CMAES(np.array([0.2, 0.8]), np.array([0.1, 0.4]), 6)
    rng = np.random.default_rng(0)
    for _ in range(5):
        z = search.sample(6, rng)
        search.tell(z, ellipsoid(z), own(6))
    n = 40_000
    z = search.sample(n, rng)
    sigma = search.sigma**2 * search.C
    std = np.sqrt(np.diag(sigma))
    np.testing.assert_allclose(search.std, std, rtol=1e-12)
    assert (np.abs(z.mean(axis=0) - search.mean) < 5 * std / np.sqrt(n)).all()
    np.testing.assert_allclose(np.cov(z.T), sigma, atol=5 * std.max() ** 2 * np.sqrt(2 / n))


@pytest.mark.parametrize("d", [1, 3, 40])
def test_injected_steps_are_cut_to_the_stated_length(d: int) -> None:
    """Hansen 2011, eq. 3: sqrt(d) + 2 d / (d + 2); steps that are short enough stay as they are."""
    limit = np.sqrt(d) + 2 * d / (d + 2)
    direction = np.ones(d) / np.sqrt(d)
    k = 8

    def mean_after(length: float, injected: bool) -> Float64:
        search = CMAES(np.full(d, 0.5), 0.1, k)
        z = np.full((k, d), 0.5)
        z[3] += 0.1 * length * direction
        flags = own(k)
        flags[3] = injected
        search.tell(z, np.array([9.0, 8, 7, 1, 6, 5, 4, 3]), flags)
        return search.mean

    at_limit = mean_after(limit, True)
    np.testing.assert_allclose(mean_after(50 * limit, True), at_limit, rtol=1e-12)
    np.testing.assert_allclose(mean_after(0.9 * limit, True), mean_after(0.9 * limit, False))
    assert (mean_after(50 * limit, False) > at_limit + 0.1).all()
    assert (at_limit > mean_after(0.9 * limit, True)).all()


def test_mean_standard_deviation_never_exceeds_that_of_the_beginning() -> None:
    """On a slope both CMA-ES widen; the limited one stops at its first width."""
    limited, free = (CMAES(np.zeros(5), 0.2, 8, widest=widest) for widest in (1.0, np.inf))
    rng = np.random.default_rng(0)
    for _ in range(60):
        for search in (limited, free):
            z = search.sample(8, rng)
            search.tell(z, z[:, 0], own(8))
        assert limited.std.mean() <= 0.2 * (1 + 1e-12)
    assert free.std.mean() > 1.0
    assert limited.std.mean() > 0.1
    assert limited.mean[0] < -1  # it still goes downhill


def test_generations_without_a_finite_loss_only_widen_until_there_is_one() -> None:
    """There is no order to learn from, but nothing to be found here either."""
    search, rng = CMAES(np.full(4, 0.5), 0.05, 8), np.random.default_rng(0)
    before = copy.deepcopy(search.state_dict())
    for factor in (2.0, 4.0):
        search.tell(search.sample(8, rng), np.full(8, np.inf), own(8))
        state = search.state_dict()
        assert state.pop("sigma") == pytest.approx(factor * before["sigma"])
        for name, value in state.items():
            np.testing.assert_array_equal(value, before[name], err_msg=name)
    for _ in range(5):
        search.tell(search.sample(8, rng), np.full(8, np.inf), own(8))
    assert search.std.mean() == pytest.approx(1 / 3)
    search.tell(z := search.sample(8, rng), z[:, 0], own(8))
    assert search.std.mean() <= 0.05 * (1 + 1e-12)  # no wider than it began, once there is a loss
    before = copy.deepcopy(search.state_dict())
    search.tell(search.sample(8, rng), np.full(8, np.inf), own(8))
    for name, value in search.state_dict().items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)


@pytest.mark.parametrize("std", [[1.0, 1e-8], [1.0, 1e-12], [1e-150, 1e150]])
def test_condition_is_held(std: list[float]) -> None:
    """C of condition 1e16 and beyond: no eigenvalue below 1e-14 of the largest."""
    search = CMAES(np.zeros(2), np.array(std), 6, widest=np.inf)
    rng = np.random.default_rng(0)
    for _ in range(20):
        z = search.sample(6, rng)
        search.tell(z, np.abs(z[:, 0]), own(6))
        check_sane(search)
        eigenvalues = np.linalg.eigvalsh(search.C)
        assert eigenvalues[-1] / eigenvalues[0] < 1.01e14


def test_only_the_order_of_losses_matters() -> None:
    results = []
    for transform in (np.asarray, np.exp, lambda losses: 1e-300 * losses):
        search = CMAES(np.zeros(3), 0.2, 7)
        z = np.random.default_rng(0).standard_normal((7, 3))
        search.tell(z, transform(ellipsoid(z) / 1e5), own(7))
        results.append((search.mean, search.sigma, search.C))
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_state_goes_on_bit_for_bit() -> None:
    def go(search: CMAES, rng: np.random.Generator) -> list[Any]:
        for _ in range(7):
            z = search.sample(9, rng)
            search.tell(z, ellipsoid(z), np.arange(9) % 4 == 0)
        return [search.mean, search.sigma, search.C, search.p_c, search.p_sigma, search.generation]

    original = CMAES(np.full(5, 0.4), np.linspace(0.1, 0.3, 5), 9)
    go(original, np.random.default_rng(0))
    copy = CMAES(np.full(5, 0.5), 1.0, 9)
    copy.load_state_dict(deepcopy(original.state_dict()))
    assert copy.largest_std == original.largest_std
    a, b = (go(search, np.random.default_rng(1)) for search in (original, copy))
    for ours, theirs in zip(a, b, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert original.state_dict().keys() == copy.state_dict().keys()


def test_of_many_parameters_the_covariance_is_decomposed_as_often_as_it_changes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every generation up to 4 k parameters, every eighth of 1,000; and it hardly matters."""
    every = {d: CMAES(np.zeros(d), 1.0, default_popsize(d))._decompose_every for d in (64, 1000)}
    assert every == {64: 1, 1000: 8}
    search = CMAES(np.full(400, 0.5), 0.2, 21, widest=np.inf)
    n = search._decompose_every
    assert n > 1
    decomposed: list[int] = []
    eigh = np.linalg.eigh

    def noted(matrix: Float64) -> tuple[Float64, Float64]:
        decomposed.append(search.generation)
        values, vectors = eigh(matrix)
        return values, vectors

    monkeypatch.setattr(np.linalg, "eigh", noted)
    rng = np.random.default_rng(0)
    for _ in range(3 * n):
        z = search.sample(21, rng)
        search.tell(z, (z**2).sum(axis=1), np.zeros(21, bool))
        C = (search._B * search._D**2) @ search._B.T
        assert np.linalg.norm(C - search.C) < 0.1 * np.linalg.norm(search.C)
    assert decomposed == [n, 2 * n, 3 * n]
    np.testing.assert_allclose(C, search.C, atol=1e-12)
    z = search.sample(21, rng)
    search.tell(z, (z**2).sum(axis=1), np.zeros(21, bool))  # B and D are of an earlier C now
    twin = CMAES(np.full(400, 0.5), 1.0, 21)
    twin.load_state_dict(search.state_dict())
    first, second = (each.sample(3, np.random.default_rng(1)) for each in (search, twin))
    np.testing.assert_array_equal(first, second)
