"""A warning names the line of the user, whatever lies between."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any

import nevergrad as ng
import numpy as np
import optuna
import pytest

from fide_adapters.nevergrad import ParametrizedFIDE
from fide_plugins import FIDE, FIDESampler, Float, Space, fit
from fide_plugins.runtime.messages import warn_user
from fide_plugins.runtime.threads import user_threads


def ours(function: Callable[[], None]) -> Callable[[], None]:
    """The function as if a module of the library had defined it."""
    assert isinstance(function, FunctionType)
    names = {**function.__globals__, "__name__": "fide_plugins.learning.somewhere"}
    return FunctionType(function.__code__, names, closure=function.__closure__)


@pytest.mark.parametrize("decorated", [False, True])
def test_the_line_is_that_of_the_call_into_the_library(decorated: bool) -> None:
    def deep() -> None:
        warn_user("look here", UserWarning)

    inner = ours(deep)
    call = user_threads(inner) if decorated else inner
    with pytest.warns(UserWarning, match="look here") as caught:
        call()
    assert Path(caught[0].filename) == Path(__file__)
    lines = Path(__file__).read_text("utf-8").splitlines()
    assert lines[caught[0].lineno - 1].strip() == "call()"


SPACE = Space(x=Float(0, 1), y=Float(0, 1))


def clip() -> None:
    opt = FIDE(SPACE, np.zeros((16, 16, 3)))
    opt.tell(opt.ask(1), np.full((1, 16, 16, 3), 1.3))


def fail() -> None:
    count = iter(range(100))

    def render(params: dict[str, float]) -> Any:
        return np.full((16, 16), params["x"]) if next(count) else None

    fit(render, np.zeros((16, 16, 3)), SPACE, 4, workers=0, seed=0)


def lack_a_parameter() -> None:
    distribution = optuna.distributions.FloatDistribution(0, 1)
    sampler = FIDESampler(search_space={"x": distribution, "y": distribution}, seed=0)
    study = optuna.create_study(sampler=sampler)
    study.optimize(lambda trial: trial.suggest_float("x", 0, 1), 1)


def lack_images() -> None:
    optimizer = ParametrizedFIDE(seed=0)(ng.p.Array(shape=(2,), lower=0, upper=1), budget=2)
    optimizer.minimize(lambda x: float(x[0]))


@pytest.mark.parametrize(
    ("act", "what"),
    [
        (clip, "are clipped"),
        (fail, "a render failed"),
        (lack_a_parameter, "suggests it not at all: the search goes by search_space"),
        (lack_images, "has no target, so it is CMA-ES"),
    ],
)
def test_each_warning_names_the_user(act: Callable[[], None], what: str) -> None:
    with pytest.warns(Warning, match=what) as caught:
        act()
    (named,) = (Path(each.filename) for each in caught if re.search(what, str(each.message)))
    assert named == Path(__file__)
