"""A small renderer as an objective, and workers that take turns in one process."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.distributions import BaseDistribution, FloatDistribution
from optuna.trial import BaseTrial, FrozenTrial

from fide_adapters.optuna import FIDESampler
from fide_adapters.optuna.study import StudyState
from fide_plugins import FIDE
from fide_plugins.types import Float32, Float64

pytest.register_assert_rewrite("optuna.testing.pytest_samplers")


WHOLE: dict[str, Any] = {"seed": 0, "popsize": 6, "proposer": "linear"}
"""Whole generations; `test_steps` has steps between them."""


class Bench:
    """A soft disk, whose place and color are looked for."""

    size = 8
    names = tuple(f"x{i}" for i in range(5))
    answer = np.array([0.7, 0.35, 0.9, 0.4, 0.2])

    def __init__(self) -> None:
        self.space: dict[str, BaseDistribution] = {
            name: FloatDistribution(0.0, 1.0) for name in self.names
        }
        self.target = self.render(self.answer)

    def render(self, x: Any) -> Float32:
        """Image (size, size, 3) of a disk at x[0:2], of color x[2:5]."""
        grid = (np.arange(self.size) + 0.5) / self.size
        distance = np.hypot(grid[None, :] - x[0], grid[:, None] - x[1])
        inside = 1 / (1 + np.exp((distance - 0.3) * 15))
        image: Float32 = (inside[..., None] * np.asarray(x[2:5])).astype(np.float32)
        return image

    def suggest(self, trial: BaseTrial) -> list[float]:
        return [trial.suggest_float(name, 0.0, 1.0) for name in self.names]

    def sampler(self, **settings: Any) -> FIDESampler:
        return FIDESampler(**{"target": self.target, **WHOLE, **settings})

    def objective(self, sampler: FIDESampler) -> Callable[[BaseTrial], float]:
        return lambda trial: sampler.tell_image(trial, self.render(self.suggest(trial)))

    def run(self, study: optuna.Study, trials: int, **settings: Any) -> None:
        study.optimize(self.objective(self.sampler_of(study)), n_trials=trials, **settings)

    @staticmethod
    def sampler_of(study: optuna.Study) -> FIDESampler:
        sampler = study.sampler
        assert isinstance(sampler, FIDESampler)
        return sampler

    def points(self, study: optuna.Study) -> Float64:
        """Parameters (n, 5) of all trials that have them."""
        trials = [t for t in study.get_trials(deepcopy=False) if len(t.params) == 5]
        return np.array([[t.params[name] for name in self.names] for t in trials])


def with_attributes(bench: Bench, attributes: dict[str, Any], value: float = 0.5) -> FrozenTrial:
    """A completed trial of the bench's space, with these attributes."""
    return optuna.create_trial(
        params=dict.fromkeys(bench.names, 0.5),
        distributions=bench.space,
        value=value,
        system_attrs=attributes,
    )


def counts_of(study: optuna.Study) -> dict[str, int]:
    return Bench.sampler_of(study).counts(study)


def state_of(study: optuna.Study) -> StudyState:
    """What the study's sampler knows; only tests look into it."""
    return Bench.sampler_of(study)._state_of(study)


def asked_by_core(bench: Bench, trials: int, **settings: Any) -> Float64:
    """Candidates (n, 5) of the core, asked by generations as a replica hands them out."""
    core = FIDE(5, bench.target, **{**WHOLE, **settings})
    asked = []
    while core.evaluations < trials:
        X = core.ask()
        asked.append(X)
        core.tell(X, np.stack([bench.render(x) for x in X]))
    return np.concatenate(asked)[:trials]


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """Optuna logs a line for every trial."""
    level = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(logging.WARNING)
    yield
    optuna.logging.set_verbosity(level)
