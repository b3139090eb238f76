"""Points of the unit cube, from whatever holds them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins import Float, Group, Int
from fide_plugins.errors import OptionError, PointsError, SpaceError
from fide_plugins.validation.points import as_points, as_whole, whole_number


def test_what_cannot_become_an_array_is_an_error_about_points() -> None:
    tensors = [torch.tensor([0.5, 0.5], requires_grad=True)] * 2
    with pytest.raises(PointsError, match=r"X must be an array of shape \(n, 2\)"):
        as_points(tensors, 2)


@pytest.mark.parametrize("value", [3, np.int64(3), np.uint8(3)])
def test_integers_are_whole_numbers_wherever_one_is_asked_for(value: Any) -> None:
    assert as_whole(value) == whole_number("n", value, 1) == Int(value, 5).low == 3
    assert type(as_whole(value)) is int
    assert value * Group(x=Float(0, 1)) == 3 * Group(x=Float(0, 1))


@pytest.mark.parametrize("value", [True, np.True_, 3.0, np.float64(3), 2.5, np.inf, "3", None])
def test_bools_floats_and_texts_are_none(value: Any) -> None:
    assert as_whole(value) is None
    with pytest.raises(SpaceError):
        Int(value, 5)
    with pytest.raises(OptionError) as error:
        whole_number("n", value, 1)
    assert str(error.value).endswith("; write 3") == (value == 3)
