"""Whatever start a user gives is rendered first, as it was given, and `best` is never worse."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import nevergrad as ng
import numpy as np
import optuna
import pytest
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from fide_adapters.nevergrad import ParametrizedFIDE
from fide_adapters.optuna import FIDESampler
from fide_plugins.types import Float32, Float64

Params: TypeAlias = dict[str, Any]

ANSWER: Params = {"x": 0.3, "gray": 0.8, "rows": 3, "shape": "square"}
GUESS: Params = {"x": 0.28, "gray": 0.77, "rows": 3, "shape": "square"}
DISTRIBUTIONS: dict[str, BaseDistribution] = {
    "x": FloatDistribution(-1, 1),
    "gray": FloatDistribution(0.01, 1, log=True),
    "rows": IntDistribution(1, 6),
    "shape": CategoricalDistribution(["disk", "square", "bar"]),
}
V, U = np.mgrid[-1:1:12j, -1:1:16j]
RENDERS = 14


def draw(p: Params) -> Float64:
    """A gray shape at x over bars."""
    far = {"disk": np.hypot(U - p["x"], V), "bar": abs(U - p["x"])}.get(
        p["shape"], np.maximum(abs(U - p["x"]), abs(V))
    )
    inside = 1 / (1 + np.exp(20 * (far - 0.5)))
    bars = 0.25 + 0.25 * np.cos(np.pi * p["rows"] * V)
    image: Float64 = inside * p["gray"] + (1 - inside) * bars
    return image


TARGET: Float32 = draw(ANSWER).astype(np.float32)


class Rendered:
    """The renderer, and what it was asked for."""

    def __init__(self) -> None:
        self.params: list[Params] = []
        self.losses: list[float] = []

    def __call__(self, p: Params) -> Float32:
        image = draw(p).astype(np.float32)  # as it is compared
        self.params.append(dict(p))
        self.losses.append(float(np.square(image - TARGET.astype(np.float64)).mean()))
        return image

    def check(self, best: float | None) -> None:
        """The contract: the guess is rendered first, as it was given, and `best` is never worse."""
        for name, value in GUESS.items():
            expected = pytest.approx(value, rel=1e-12) if isinstance(value, float) else value
            assert self.params[0][name] == expected, name
        assert best is not None and best <= self.losses[0] * (1 + 1e-6)


# -- ways of giving a start ------------------------------------------------------------------------


def suggest(trial: Any) -> Params:
    return {
        "x": trial.suggest_float("x", -1, 1),
        "gray": trial.suggest_float("gray", 0.01, 1, log=True),
        "rows": trial.suggest_int("rows", 1, 6),
        "shape": trial.suggest_categorical("shape", ["disk", "square", "bar"]),
    }


def enqueued(render: Rendered, seed: int, space: dict[str, BaseDistribution] | None) -> None:
    sampler = FIDESampler(TARGET, seed=seed, search_space=space)
    study = optuna.create_study(sampler=sampler)
    study.enqueue_trial(GUESS)
    study.optimize(lambda t: sampler.tell_image(t, render(suggest(t))), n_trials=RENDERS)
    assert sampler.counts(study) == {"member": RENDERS, "image": RENDERS}  # the guess is one
    render.check(study.best_value)


def parametrized(guess: Params | None) -> Any:
    made = ng.p.Dict(
        x=ng.p.Scalar(lower=-1, upper=1),
        gray=ng.p.Log(lower=0.01, upper=1),
        rows=ng.p.Scalar(lower=1, upper=6).set_integer_casting(),
        shape=ng.p.Choice(["disk", "square", "bar"]),
    )
    made.random_state.seed(7)
    if guess is not None:
        made.value = guess
    return made


def by_nevergrad(render: Rendered, seed: int, suggested: bool) -> None:
    parametrization = parametrized(None if suggested else GUESS)
    optimizer = ParametrizedFIDE(target=TARGET, seed=seed)(parametrization, budget=RENDERS)
    if suggested:
        optimizer.suggest(GUESS)
    for _ in range(RENDERS):
        candidate = optimizer.ask()
        optimizer.tell(candidate, render(candidate.value))
    render.check(optimizer.recommend().loss)


WAYS: dict[str, Callable[[Rendered, int], None]] = {
    "optuna": lambda render, seed: enqueued(render, seed, None),
    "optuna, its space": lambda render, seed: enqueued(render, seed, DISTRIBUTIONS),
    "nevergrad, value": lambda render, seed: by_nevergrad(render, seed, suggested=False),
    "nevergrad, suggest": lambda render, seed: by_nevergrad(render, seed, suggested=True),
}


@pytest.fixture(autouse=True)
def quiet() -> None:
    optuna.logging.set_verbosity(optuna.logging.WARNING)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("way", WAYS)
def test_a_start_is_rendered_first_and_best_is_never_worse(way: str, seed: int) -> None:
    WAYS[way](Rendered(), seed)


# -- where the search goes on ----------------------------------------------------------------------


def test_the_search_begins_at_the_first_enqueued_trial() -> None:
    """All workers know it from the storage; a later one is a point like any other."""
    storage = optuna.storages.InMemoryStorage()
    values = []
    for worker in range(3):
        sampler = FIDESampler(TARGET, seed=0, sigma0=0.01)
        study = optuna.create_study(
            study_name="s", storage=storage, sampler=sampler, load_if_exists=True
        )
        if not worker:
            study.enqueue_trial({"x": 0.28, "gray": 0.5})
            study.enqueue_trial({"x": -0.9, "gray": 0.02})
        for _ in range(2):
            trial = study.ask()
            values.append([trial.suggest_float("x", -1, 1), trial.suggest_float("gray", 0.01, 1)])
            study.tell(trial, sampler.tell_image(trial, np.full(TARGET.shape, values[-1][1])))
    assert values[:2] == [[0.28, 0.5], [-0.9, 0.02]]
    np.testing.assert_allclose(values[2:], np.tile([0.28, 0.5], (4, 1)), atol=0.1)
    newcomer = FIDESampler(TARGET, seed=0, sigma0=0.01)
    assert newcomer.counts(study) == {"member": 5, "injected": 1, "image": 6}


@pytest.mark.parametrize(
    "parametrization",
    [
        ng.p.Array(shape=(3,), lower=0, upper=1),
        ng.p.Array(shape=(3,)),
        ng.p.Dict(a=ng.p.Log(lower=1e-3, upper=10), b=ng.p.Choice([1, 2, 3])),
    ],
)
def test_an_initial_value_that_nevergrad_has_chosen_is_no_guess(parametrization: Any) -> None:
    optimizer = ParametrizedFIDE(seed=0)(parametrization, budget=9)
    with pytest.warns(Warning, match="has no target"):
        optimizer.ask()
    assert optimizer.fide.guess is None
