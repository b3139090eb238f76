"""The smallest and the largest of everything: parameters, candidates, pixels, numbers told."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fide_plugins.errors import ImageError
from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64


def shown(X: Float64, size: tuple[int, int]) -> Float32:
    """Images (n, H, W, 3), gray, as bright as the mean of the parameters, brighter to the right."""
    ramp = np.linspace(0.2, 1.0, size[1], dtype=np.float32)
    images: Float32 = np.empty((len(X), *size, 3), np.float32)
    images[:] = X.mean(axis=1).astype(np.float32)[:, None, None, None] * ramp[:, None]
    return images


def run(dim: int, size: tuple[int, int], generations: int, **settings: Any) -> FIDE:
    """Check what was asked, what was learned, and that the same seed asks the same."""
    target = shown(np.full((1, dim), 0.7), size)[0]
    opt, twin = (FIDE(dim, target, seed=3, **settings) for _ in range(2))
    best = np.inf
    for _ in range(generations):
        X = opt.ask()
        np.testing.assert_array_equal(twin.ask(), X)
        assert X.shape[1] == dim and ((X >= 0) & (X <= 1)).all()
        for each in (opt, twin):
            each.tell(X, shown(X, size))
        assert opt.best is not None and opt.best.loss <= best
        best = opt.best.loss
    np.testing.assert_array_equal(opt.ask(), twin.ask())
    search = opt.state.search.distribution
    np.testing.assert_array_equal(search.C, search.C.T)
    assert np.isfinite(search.C).all() and search._D.min() > 0
    return opt


@pytest.mark.parametrize("dim", [1, 64, 512])
def test_parameters(dim: int) -> None:
    opt = run(dim, (4, 4), 4)
    assert opt.best is not None and opt.best.loss < 0.02


@pytest.mark.parametrize("popsize", [4, 4096])
def test_candidates_of_a_generation(popsize: int) -> None:
    opt = run(2, (1, 1), 1, popsize=popsize)
    assert opt.evaluations == popsize


@pytest.mark.parametrize("size", [(1, 1), (1, 300), (16, 4096), (4096, 16)])
def test_pixels(size: tuple[int, int]) -> None:
    opt = run(2, size, 4)
    tokens, channels = opt.features_shape
    assert 1 <= tokens <= 256 and channels == 16


def refused(images: Any, opt: FIDE, X: Float64) -> None:
    """And nothing of it is remembered."""
    before = opt.state.population.pending, opt.evaluations, opt.state.rng.bit_generator.state
    with pytest.raises(ImageError):
        opt.tell(X, images)
    assert (
        opt.state.population.pending,
        opt.evaluations,
        opt.state.rng.bit_generator.state,
    ) == before


@pytest.mark.parametrize("value", [1e30, 3e38, 1e300])
def test_a_brightness_beyond_any_scale_is_refused(value: float) -> None:
    opt = FIDE(2, np.zeros((2, 2, 3)), seed=0)
    X = opt.ask()
    refused(np.full((len(X), 2, 2, 3), value), opt, X)
