"""Acceptance point 19: names, settings, and what importing does."""

from __future__ import annotations

import importlib
import subprocess
import sys

import nevergrad as ng
import numpy as np
import pytest

import fide_adapters.nevergrad as door
from fide_adapters.nevergrad import FIDE, ParametrizedFIDE
from fide_plugins.errors import ImageError, OptionError, ProtocolError, UnknownNameError

from .conftest import TARGET, box, fide

PROBE = """
import sys
from nevergrad.optimization.base import registry
import nevergrad
before = dict(registry.data)
import fide_adapters.nevergrad
print("added", *sorted(set(registry) - set(before)))
print("changed", *(name for name in before if registry[name] is not before[name]))
import fide_adapters.nevergrad
importlib = __import__("importlib")
first = registry["FIDE"]
assert importlib.reload(fide_adapters.nevergrad).FIDE is first is registry["FIDE"]
optimizers = [registry["FIDE"](4, budget=10) for _ in range(3)]
print("imported", *sorted({"torch", "optuna", "mitsuba", "mujoco"} & set(sys.modules)))
for name in [n for n in sys.modules if n.startswith("fide_adapters")]:
    del sys.modules[name]
import fide_adapters.nevergrad
assert registry["FIDE"] is fide_adapters.nevergrad.FIDE is not first
"""


@pytest.mark.thorough
def test_point_19_importing_registers_one_name_and_loads_nothing() -> None:
    output = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", PROBE], capture_output=True, text=True, check=True
    )
    assert output.stdout.splitlines() == ["added FIDE", "changed", "imported"]


def test_point_19_a_name_of_somebody_else_is_not_taken() -> None:
    registry = ng.optimizers.registry
    try:
        registry.data["FIDE"] = ng.optimizers.CMA
        with pytest.raises(RuntimeError, match="collision"):
            importlib.reload(door)
    finally:
        registry.data["FIDE"] = FIDE


def test_point_19_it_is_made_like_any_other() -> None:
    made = ng.optimizers.registry["FIDE"](box(), 50, 3)
    assert (made.name, made.budget, made.num_workers, made.dimension) == ("FIDE", 50, 3, 6)
    assert repr(made) == (
        "Instance of FIDE(parametrization=Array{(6,),Cl(0,1,b)}[sigma=0.16666666666666666], "
        "budget=50, num_workers=3)"
    )
    assert not (FIDE.recast or FIDE.one_shot or FIDE.no_parallelization)


def test_point_19_settings() -> None:
    default, other = ParametrizedFIDE(), ParametrizedFIDE(popsize=9, target=TARGET)
    assert repr(default) == "ParametrizedFIDE()" and repr(FIDE) == "FIDE"
    assert repr(other).startswith("ParametrizedFIDE(popsize=9, target=<16 x 16 ")
    assert default == FIDE != other
    assert other == ParametrizedFIDE(**other.config())
    assert other == ParametrizedFIDE(popsize=9, target=np.array(TARGET))
    assert other != ParametrizedFIDE(popsize=9, target=TARGET * 0.5)
    assert set(other.config()) == {
        "target", "loss", "preset", "encoder", "popsize", "device", "seed", "options",
        "mask", "weights", "value_range",
    }  # fmt: skip
    optimizer = other(box(), budget=10)
    assert optimizer._configured_optimizer is other and optimizer.name == repr(other)


def test_point_19_bad_settings() -> None:
    with pytest.raises(TypeError, match="population"):
        ParametrizedFIDE(population=3)  # type: ignore[call-arg]
    with pytest.raises(OptionError, match="popsize"):
        ParametrizedFIDE(popsize=2)
    with pytest.raises(OptionError, match="population"):
        ParametrizedFIDE(options={"population": 3})
    for name in set(ParametrizedFIDE().config()) - {"options"}:
        with pytest.raises(OptionError, match=f"{name} is an argument of its own"):
            ParametrizedFIDE(options={name: None})
    for name in ("x0", "sigma0"):
        with pytest.raises(OptionError, match=f"{name} is .* of the parametrization: not options"):
            ParametrizedFIDE(options={name: 0.1})
    with pytest.raises(OptionError, match="must be a dictionary of options"):
        ParametrizedFIDE(options="proposer=none")  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match="fast"):
        ParametrizedFIDE(preset="fats")
    with pytest.raises(OptionError, match="seed"):
        ParametrizedFIDE(seed=-1)
    with pytest.raises(ImageError, match="target"):
        ParametrizedFIDE(target=np.zeros(3))


def test_the_target_may_be_set_until_the_search_begins() -> None:
    optimizer = fide(target=None)
    assert optimizer.target is None
    with pytest.raises(ImageError, match=r"absent\.png"):
        optimizer.target = "absent.png"
    optimizer.target = (TARGET * 255).round().astype(np.uint8)
    np.testing.assert_allclose(optimizer.target, TARGET, atol=0.5 / 255)
    optimizer.target = TARGET
    optimizer.ask()
    with pytest.raises(ProtocolError, match="before the first ask"):
        optimizer.target = TARGET
    with pytest.raises(ValueError, match="read-only"):
        optimizer.target[0, 0] = 0
