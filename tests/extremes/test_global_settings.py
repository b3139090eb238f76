"""Global settings of PyTorch and NumPy that a user has made: they change no result."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins import Choice, Float, Solution, Space, fit
from fide_plugins.fide import FIDE
from fide_plugins.learning import learn
from fide_plugins.types import Float64
from fide_plugins.uncertainty import estimate
from fide_plugins.uncertainty.estimate import looks_alike

_GRID = (np.arange(16) + 0.5) / 16
BLOCKS = [[0, 1], [2, 3]]


def disks(x: Float64) -> Float64:
    """Two soft disks at (x_0, x_1) and (x_2, x_3)."""
    pairs = np.asarray(x).reshape(2, 2)
    each = [np.hypot(_GRID[None] - a, _GRID[:, None] - b) for a, b in pairs]
    image: Float64 = sum(0.5 / (1 + np.exp((distance - 0.2) * 15)) for distance in each)
    return image


SPACE = Space(x=Float(0, 1), gray=Choice(1.0, 0.7, 0.4))


def disk(params: dict[str, Any]) -> Float64:
    """Soft disk, in one of three grays."""
    distance = np.hypot(_GRID[None] - params["x"], _GRID[:, None] - 0.5)
    disk: Float64 = params["gray"] / (1 + np.exp((distance - 0.2) * 15))
    return disk


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


def same(one: torch.nn.Module, other: torch.nn.Module) -> bool:
    mine, theirs = one.state_dict(), other.state_dict()
    return mine.keys() == theirs.keys() and all(
        torch.equal(value, theirs[name]) and value.dtype == theirs[name].dtype
        for name, value in mine.items()
    )


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


@pytest.mark.parametrize("groups", [[], BLOCKS])
def test_learning_is_the_same_where_double_precision_is_the_default(
    double: Any, groups: list[list[int]]
) -> None:
    options: dict[str, Any] = {"renders": 200, "passes": 1, "size": 16}
    made = partial(learn, disks, 4, groups=groups, **options)
    expected, model = made(), double(made)
    assert same(model.network, expected.network) and model.report.curve == expected.report.curve
    picture = disks(np.array([0.3, 0.4, 0.7, 0.6]))
    np.testing.assert_array_equal(double(model.sample, picture, 5), expected.sample(picture, 5))
    if expected.emulator is not None:
        assert same(model.emulator, expected.emulator)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_learning_is_the_same_where_the_caller_wants_no_gradients(
    mode: type[AbstractContextManager[None]],
) -> None:
    made = partial(learn, disks, 4, renders=200, passes=1, size=16, groups=BLOCKS)
    expected = made()
    with mode():
        model = made()
    assert same(model.network, expected.network) and model.report.curve == expected.report.curve
    assert model.emulator is not None and expected.emulator is not None
    assert same(model.emulator, expected.emulator)
    assert not any(weight.is_inference() for weight in model.network.parameters())


def test_standard_deviations_are_the_same_where_floating_point_errors_raise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also where differences underflow, which depends on the processor."""

    def underflowing(*args: Any) -> bool:
        assert np.float64(1e-300) * np.float64(1e-300) == 0.0
        return looks_alike(*args)

    def fitted() -> Solution:
        result = fit(
            disk, disk({"x": 0.7, "gray": 0.7}), SPACE, 200, until="budget", workers=0, seed=0
        )
        assert result.best is not None
        return result.best

    expected = fitted()
    monkeypatch.setattr(estimate, "looks_alike", underflowing)
    with np.errstate(all="raise"):
        best = fitted()
        std = best.std
    assert std is not None and expected.std is not None
    np.testing.assert_array_equal(std, expected.std)
    assert best.undetermined == expected.undetermined
