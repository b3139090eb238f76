"""Points of the unit cube, from whatever holds them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fide_plugins.errors import PointsError
from fide_plugins.validation.points import as_points


def test_a_tensor_that_is_being_differentiated() -> None:
    X = torch.tensor([[0.25, 1.0]], dtype=torch.float64, requires_grad=True)
    np.testing.assert_array_equal(as_points(X, 2), [[0.25, 1.0]])


def test_what_cannot_become_an_array_is_an_error_about_points() -> None:
    tensors = [torch.tensor([0.5, 0.5], requires_grad=True)] * 2
    with pytest.raises(PointsError, match=r"X must be an array of shape \(n, 2\)"):
        as_points(tensors, 2)
