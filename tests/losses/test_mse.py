import numpy as np
import pytest

from fide_plugins.losses.base import MeanSquaredError

RNG = np.random.default_rng(6)


def test_equals_numpy() -> None:
    target, *images = RNG.random((6, 31, 17, 3), dtype=np.float32)
    expected = [np.mean((x.astype(np.float64) - target) ** 2) for x in images]
    np.testing.assert_allclose(MeanSquaredError(target)(images), expected, rtol=1e-14)


def test_differences_below_single_precision_of_the_mean_count() -> None:
    target = np.full((112, 112, 3), 0.5, np.float32)
    image = target.copy()
    image[0, 0, 0] += 2.0**-20
    expected = 2.0**-40 / target.size
    assert MeanSquaredError(target)(image[None])[0] == pytest.approx(expected, rel=1e-14)
