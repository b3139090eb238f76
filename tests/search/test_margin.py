"""CMA-ES with margin: the numbers of `cmaes.CMAwM`, and the probabilities that it promises."""

from __future__ import annotations

import copy

import cmaes
import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.special import ndtr

from fide_plugins.search.mixed import correct_steps
from fide_plugins.types import Float64

alphas = st.floats(1e-4, 0.1)
stds = st.floats(-6, 1).map(lambda e: 10.0**e)


def cell(m: Float64, n: int) -> tuple[Float64, Float64]:
    """Where the cell of each mean begins and ends, of n equal cells of [0, 1]."""
    k = np.clip(np.floor(m * n), 0, n - 1)
    lower, upper = k / n, (k + 1) / n
    return np.where(k == 0, -np.inf, lower), np.where(k == n - 1, np.inf, upper)


@pytest.mark.parametrize("cells", [2, 3, 6])
def test_numbers_are_those_of_the_library(cells: int) -> None:
    """Mean and A after the margin, generation after generation, from its mean and Sigma before."""
    d, k = 4, 8
    bounds = np.array([[0, cells - 1]] * 3 + [[-10, 10]], float)
    theirs = cmaes.CMAwM(
        np.full(d, 0.6), 0.5, bounds, np.array([1.0, 1.0, 1.0, 0.0]), seed=cells, population_size=k
    )
    assert theirs.margin == 1 / (d * k)
    corrected = 0
    for _ in range(150):
        asked = [theirs.ask() for _ in range(k)]
        told = [(raw, float(((x - [1, 0, cells - 1, 0.3]) ** 2).sum())) for x, raw in asked]
        A = theirs._A[:3].copy()
        inner = copy.deepcopy(theirs._cma)
        inner.tell([(x.copy(), v) for x, v in told])
        theirs.tell(told)
        m = inner._mean[:3]
        unstretched = inner._sigma * np.sqrt(np.diag(inner._C)[:3])
        in_unit = (m + 0.5) / cells  # whole numbers are the middles of equal cells
        lower, upper = cell(in_unit, cells)
        mean, s = correct_steps(in_unit, unstretched * A / cells, lower, upper, theirs.margin)
        np.testing.assert_allclose(mean * cells - 0.5, theirs._cma._mean[:3], rtol=0, atol=1e-7)
        np.testing.assert_allclose(s * cells / unstretched, theirs._A[:3], rtol=1e-5)
        corrected += bool(np.abs(mean - in_unit).max() > 1e-9)
        if inner._sigma < 1e-8:
            break
    assert corrected > 10


@given(
    st.lists(st.tuples(st.floats(-3, 4), stds), min_size=1, max_size=5), alphas, st.integers(2, 9)
)
def test_the_cell_is_left_with_probability_alpha(
    axes: list[tuple[float, float]], alpha: float, n: int
) -> None:
    m, s = np.array(axes).T
    lower, upper = cell(m, n)
    mean, std = correct_steps(m, s, lower, upper, alpha)
    below, above = ndtr((lower - mean) / std), ndtr((mean - upper) / std)
    for side, edge in ((below, lower), (above, upper)):
        both = np.isfinite(lower) & np.isfinite(upper)
        least = np.where(both, alpha / 2, alpha)
        has = np.isfinite(edge)
        assert (side[has] >= least[has] * (1 - 1e-6) - 1e-9).all()
    assert ((mean >= np.maximum(lower, -1e9)) & (mean <= np.minimum(upper, 1e9))).all()
    again, same = correct_steps(mean, std, lower, upper, alpha)
    np.testing.assert_allclose(again, mean, rtol=0, atol=1e-7)
    np.testing.assert_allclose(same, std, rtol=1e-6)
