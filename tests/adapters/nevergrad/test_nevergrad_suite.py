"""Acceptance point 20: Nevergrad's own tests of optimizers, called on FIDE.

They come with Nevergrad.  Those that choose names by a hash of them are called with an alias that
is chosen.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import nevergrad as ng
import numpy as np
import pytest
from nevergrad.optimization import optimizerlib

from fide_adapters.nevergrad import ParametrizedFIDE

from .conftest import fide

pytestmark = pytest.mark.filterwarnings("ignore::nevergrad.common.errors.NevergradWarning")

ALIAS = "Fide"  # its hash is 0 modulo 5, where theirs wants that


@pytest.fixture(scope="module")
def theirs() -> Any:
    state = np.random.get_state()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from nevergrad.optimization import test_base, test_optimizerlib, test_suggest
    np.random.set_state(state)  # they seed it when they are imported

    class Theirs:
        base, lib, suggest = test_base, test_optimizerlib, test_suggest

    return Theirs


@pytest.fixture
def alias(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    made = ParametrizedFIDE().set_name(ALIAS, register=True)
    monkeypatch.setattr(optimizerlib, ALIAS, made, raising=False)
    yield ALIAS
    ng.optimizers.registry.unregister(ALIAS)


def test_point_20_check_optimizer(theirs: Any) -> None:
    theirs.lib.check_optimizer(ng.optimizers.registry["FIDE"], budget=300)


def test_point_20_infnan(theirs: Any, alias: str) -> None:
    theirs.lib.test_infnan(alias)


def test_point_20_optimizers(theirs: Any, alias: str) -> None:
    theirs.lib.test_optimizers(alias)


def test_point_20_optimizers_minimal(theirs: Any) -> None:
    """In one dimension, without fcmaes."""
    with pytest.raises(ImportError):
        __import__("fcmaes")
    theirs.lib.test_optimizers_minimal("FIDE")


def test_point_20_parametrization_offset(theirs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(theirs.lib, "long_name", lambda name: False)  # which leaves most out
    theirs.lib.test_parametrization_offset("FIDE")


def test_point_20_pickle(theirs: Any) -> None:
    theirs.lib.test_optim_pickle("FIDE")


def test_point_20_suggest(theirs: Any) -> None:
    theirs.suggest.test_optimizers_suggest("FIDE")


def test_point_20_suggest_among_whole_numbers(theirs: Any) -> None:
    instrumentation = ng.p.Array(shape=(100,)).set_bounds(0.0, 1.0)
    instrumentation.set_integer_casting()
    suggestion = np.asarray([0] * 17 + [1] * 17 + [0] * 66)

    def target(x: Any) -> int:
        return int(not np.array_equal(np.asarray(x, int), suggestion))

    theirs.suggest.suggestion_testing("FIDE", instrumentation, suggestion, 7, target)


def test_point_20_several_objectives(theirs: Any) -> None:
    theirs.lib.test_mo_constrained("FIDE")
    theirs.lib.test_mo_with_nan("FIDE")


@pytest.mark.parametrize(
    ("value", "error"),
    [
        (3, False),
        (True, False),
        (np.int32(3), False),
        (np.float64(3), False),
        (np.float32(3), False),
        (np.array(3.0), False),
        ([3, 5], False),
        ((3, 5), False),
        (1j, True),
        (object(), True),
        ("3", True),
        (None, True),
    ],
)
def test_point_20_tell_types(value: Any, error: bool) -> None:
    """As theirs of the same name, which is about a class of its own."""
    optimizer = fide(target=None)
    penalties: list[tuple[Any, ...]] = [(), ([3.0, 5.0, -1.0],), ([3.0, 5.0, -1.0], [1.0] * 6)]
    for more in penalties:
        candidate = optimizer.ask()
        if error:
            with pytest.raises((TypeError, ValueError)):
                optimizer.tell(candidate, value, *more)
        else:
            optimizer.tell(candidate, value, *more)
    assert optimizer.num_tell == (0 if error else 3)


@pytest.mark.parametrize(
    "as_layer",
    [False, pytest.param(True, marks=pytest.mark.slow)],  # Nevergrad's layers search too
)
def test_point_20_constrained_optimization(as_layer: bool) -> None:
    """As theirs of the same name: (x - 1/2)^2 + |y| with x >= 1."""

    def constraint(i: Any) -> bool | float:
        inside = i[1]["x"][0] >= 1
        return float(not inside) if as_layer else bool(inside)

    parametrization = ng.p.Instrumentation(x=ng.p.Array(shape=(1,)), y=ng.p.Scalar())
    optimizer = ng.optimizers.registry["FIDE"](parametrization, budget=150)
    parametrization.random_state.seed(12)
    optimizer.parametrization.register_cheap_constraint(constraint, as_layer=as_layer)
    recommended = optimizer.minimize(lambda x, y: float((x[0] - 0.5) ** 2 + abs(y)))
    assert recommended.kwargs["x"][0] == pytest.approx(1.0, abs=0.03)
    assert recommended.kwargs["x"][0] >= 1 or as_layer
    assert recommended.kwargs["y"] == pytest.approx(0.0, abs=0.03)
