"""The search distribution stays a distribution, whatever it is told."""

from __future__ import annotations

import os

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings, strategies as st

from fide_plugins.search import mixed
from fide_plugins.search.cma_es import CMAES
from fide_plugins.types import Float64

CASES = int(os.environ.get("FIDE_CASES", "1"))  # times as many as in CI

LOSSES = (
    "constant",
    "equal but one",
    "from 1e-300 to 1e300",
    "denormal",
    "infinite, a share",
    "all infinite",
    "first parameter",
    "distance",
    "minus the distance",
    "noise",
)
INJECTED = ("none", "a third", "all", "far", "one point", "the mean", "a corner")


def losses_of(what: str, z: Float64, rng: np.random.Generator) -> Float64:
    """Losses (k,) of candidates z (k, d)."""
    k = len(z)
    with np.errstate(over="ignore"):
        distance: Float64 = np.square(z - 0.3).sum(axis=1)
    kinds: dict[str, Float64] = {
        "constant": np.full(k, rng.choice([0.0, -1e300, 7.0])),
        "equal but one": -1.0 * (np.arange(k) == rng.integers(k)),
        "from 1e-300 to 1e300": np.power(10.0, rng.uniform(-300, 300, k)),
        "denormal": np.multiply(5e-324, rng.integers(0, 3, k)),
        "infinite, a share": np.where(rng.random(k) < rng.random(), np.inf, z[:, 0]),
        "all infinite": np.full(k, np.inf),
        "first parameter": np.array(z[:, 0]),
        "distance": distance,
        "minus the distance": -distance,
        "noise": rng.random(k),
    }
    return kinds[what]


def replace(
    what: str, z: Float64, search: CMAES, rng: np.random.Generator
) -> tuple[Float64, npt.NDArray[np.bool_]]:
    """Candidates (k, d), some of them injected, and which."""
    k, d = z.shape
    share = {"none": 0.0, "all": 1.0}.get(what, 0.3)
    injected: npt.NDArray[np.bool_] = np.less(rng.random(k), share)
    n = int(injected.sum())
    points = {
        "far": rng.standard_normal((n, d)) * 10.0 ** rng.uniform(-3, 30, (n, 1)),
        "one point": np.full((n, d), 0.7),
        "the mean": np.tile(search.mean, (n, 1)),
        "a corner": np.zeros((n, d)),
    }.get(what, rng.random((n, d)))
    z[injected] = mixed.closest(points, search.mean) if what != "far" else points
    return z, injected


def check(search: CMAES, losses: Float64 | None = None) -> None:
    """After a generation with these losses; None: before any."""
    assert np.isfinite(search.mean).all()
    assert np.isfinite(search.sigma) and search.sigma > 0
    assert np.isfinite(search.C).all()
    np.testing.assert_array_equal(search.C, search.C.T)
    np.linalg.cholesky(search.C)  # raises unless it is positive definite
    assert np.isfinite(search._D).all() and search._D.min() > 0  # what samples are drawn by
    assert np.isfinite(search.std).all() and (search.std > 0).all()
    widened = losses is not None and not np.isfinite(losses).any()
    widest = max(search.largest_std, 1 / 3 if widened else 1e-14)
    assert search.std.mean() <= widest * (1 + 1e-4)
    assert np.isfinite(search.p_sigma).all() and np.isfinite(search.p_c).all()


@pytest.mark.parametrize("losses", LOSSES)
def test_candidates_beyond_any_sample_leave_the_covariance_positive_definite(losses: str) -> None:
    """Of many parameters C is decomposed now and then; told of candidates 1e30 away, at once."""
    rng = np.random.default_rng(1)
    search = CMAES(np.full(64, 0.5), 1 / 6, 4)
    assert search._decompose_every > 1
    for _ in range(9):
        z, _ = replace("far", search.sample(4, rng), search, rng)
        values = losses_of(losses, z, rng)
        search.tell(z, values, np.zeros(4, bool))
        check(search, values)


def check_samples(search: CMAES) -> None:
    x = mixed.into(search.sample(3, np.random.default_rng(0)))
    assert ((x >= 0) & (x <= 1)).all()


dims = st.one_of(st.integers(1, 12), st.sampled_from([33, 64, 130]))
popsizes = st.one_of(st.integers(2, 20), st.sampled_from([4, 50, 130]))
exponents = st.floats(-12, 6)


@pytest.mark.thorough
@settings(max_examples=250 * CASES, deadline=None)
@given(
    d=dims,
    k=popsizes,
    width=exponents,
    spread=st.sampled_from([0.0, 1.0, 9.0, 20.0]),
    limit=st.booleans(),
    losses=st.sampled_from(LOSSES),
    injected=st.sampled_from(INJECTED),
    guarded=st.booleans(),
    seed=st.integers(0, 2**32),
)
def test_a_distribution_after_every_generation(
    d: int, k: int, width: float, spread: float, limit: bool, losses: str, injected: str,
    guarded: bool, seed: int,
) -> None:  # fmt: skip
    rng = np.random.default_rng(seed)
    std = 10.0**width * 10.0 ** rng.uniform(-spread, 0, d)
    search = CMAES(np.full(d, 0.5), std, k, widest=1.0 if limit else np.inf)
    check(search)
    for _ in range(8):
        z, flags = replace(injected, search.sample(k, rng), search, rng)
        values = losses_of(losses, z, rng)
        search.tell(z, values, flags & guarded)
        check(search, values)
    check_samples(search)
