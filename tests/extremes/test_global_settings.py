"""Global settings of PyTorch and NumPy that a user has made: they change no result."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins.fide import FIDE
from fide_plugins.types import Float64

_GRID = (np.arange(16) + 0.5) / 16


def disks(x: Float64) -> Float64:
    """Two soft disks at (x_0, x_1) and (x_2, x_3)."""
    pairs = np.asarray(x).reshape(2, 2)
    each = [np.hypot(_GRID[None] - a, _GRID[:, None] - b) for a, b in pairs]
    image: Float64 = sum(0.5 / (1 + np.exp((distance - 0.2) * 15)) for distance in each)
    return image


@pytest.fixture
def double() -> Iterator[Any]:
    """Calls a function where double precision is PyTorch's default."""
    before = torch.get_default_dtype()

    def call(function: Any, *args: Any, **options: Any) -> Any:
        torch.set_default_dtype(torch.float64)
        try:
            return function(*args, **options)
        finally:
            torch.set_default_dtype(before)

    yield call
    torch.set_default_dtype(before)


@pytest.mark.parametrize("options", [{}, {"preset": "paper", "popsize": 8, "epochs": 2}])
def test_candidates_are_the_same_where_double_precision_is_the_default(
    double: Any, options: dict[str, Any]
) -> None:
    def second_generation() -> Float64:
        opt = FIDE(4, disks(np.array([0.3, 0.4, 0.7, 0.6])), seed=0, **options)
        for _ in range(2):
            X = opt.ask()
            opt.tell(X, np.stack([disks(x) for x in X]))
        return opt.ask()

    np.testing.assert_array_equal(double(second_generation), second_generation())
