"""Runs of the adapters and of the command line for `golden`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import numpy as np
from golden_search import Float32, Float64, Trace, problem


def nevergrad(trace: Trace, workers: int, images: bool, budget: int = 300) -> None:
    """The optimizer of the registry, several candidates at a time, told backwards."""
    import nevergrad as ng

    import fide_adapters.nevergrad  # noqa: F401  # registers

    p = problem(cells=3)
    parametrization = ng.p.Array(shape=(p.dim,), lower=0, upper=1)
    parametrization.random_state.seed(5)
    known = ng.optimizers.registry["FIDE"]
    opt = known(parametrization, budget=budget, num_workers=workers)
    opt.target = p.target
    for _ in range(budget // workers):
        asked = [opt.ask() for _ in range(workers)]
        X = np.array([candidate.value for candidate in asked])
        pictures = p.render(X)
        values = p.loss(pictures)
        for i in reversed(range(workers)):
            if images and i % 2:
                opt.tell(asked[i], pictures[i])
            elif images:
                opt.tell(asked[i], float(values[i]), image=pictures[i])
            else:
                opt.tell(asked[i], float(values[i]))
        trace.note(candidates=X, losses=values, recommend=opt.recommend().value)


def nevergrad_mixed(trace: Trace) -> None:
    """A parametrization with a choice and a logarithmic scalar, and a settings object."""
    import nevergrad as ng

    from fide_adapters.nevergrad import ImageLoss, ParametrizedFIDE

    p = problem(cells=1)
    values: list[str] = []

    def objective(where: Any, shade: float, bright: str) -> ImageLoss:
        x = np.array([*where, shade, shade, 0.9 if bright == "yes" else 0.1])
        values.append(json.dumps([*map(float, where), float(shade), bright]))
        image = p.render(x[None, : p.dim])
        return ImageLoss(float(p.loss(image)[0]), image[0])

    space = ng.p.Instrumentation(
        ng.p.Array(shape=(2,), lower=0, upper=1),
        ng.p.Log(lower=0.01, upper=1),
        ng.p.Choice(["no", "yes"]),
    )
    space.random_state.seed(7)
    made = ParametrizedFIDE(target=p.target, preset="fast", popsize=8)
    found = made(space, budget=200).minimize(objective)
    for value in values:
        trace.note(candidates=value)
    trace.note(recommend=repr((found.args[0].tolist(), float(found.args[1]), found.args[2])))


def suggest(trial: Any, mixed: bool) -> Float64:
    """Parameters (6,) of a trial in [0, 1], of every kind Optuna has, or six floats."""
    if not mixed:
        return np.array([trial.suggest_float(f"x{i}", 0, 1) for i in range(6)])
    x = trial.suggest_float("x", -3, 3) / 6 + 0.5
    y = trial.suggest_float("y", 0, 1, step=0.05)
    red = trial.suggest_int("red", 0, 20) / 20
    green = np.log10(trial.suggest_float("green", 1e-3, 1, log=True)) / 3 + 1
    blue = {"low": 0.1, "middle": 0.5, "high": 0.9}[
        trial.suggest_categorical("blue", ["low", "middle", "high"])
    ]
    n = trial.suggest_int("n", 1, 64, log=True) / 64
    return np.asarray(np.clip([x, y, red, green, blue, n], 0, 1), np.float64)


def disks(X: Float64) -> Float32:
    """Images (n, 24, 24, 3) of soft disks: place, color and radius by the columns of X (n, 6)."""
    grid = (np.arange(24) + 0.5) / 24
    x, y, radius = (X[:, i, None, None] for i in (0, 1, 5))
    distance = np.hypot(grid[None, None, :] - x, grid[None, :, None] - y)
    inside = 1 / (1 + np.exp((distance - 0.1 - 0.3 * radius) * 15))
    images: Float32 = (inside[..., None] * X[:, None, None, 2:5]).astype(np.float32)
    return images


def optuna(
    trace: Trace, mixed: bool = False, parallel: int = 1, trials: int = 150, sqlite: bool = False
) -> None:
    """A study; several trials at a time end backwards; with `sqlite` two samplers take turns."""
    import optuna

    from fide_adapters.optuna import FIDESampler

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    target = disks(np.array([[0.7, 0.35, 0.9, 0.4, 0.2, 0.5]]))[0]
    storage = f"sqlite:///{trace.folder / 'study.db'}" if sqlite else None
    samplers = [FIDESampler(target=target, seed=0, popsize=8) for _ in range(1 + sqlite)]
    studies = [
        optuna.create_study(
            storage=storage, sampler=sampler, study_name="golden", load_if_exists=True
        )
        for sampler in samplers
    ]
    for turn in range(trials // parallel):
        study, sampler = studies[turn % len(studies)], samplers[turn % len(samplers)]
        asked = [study.ask() for _ in range(parallel)]
        X = np.array([suggest(trial, mixed) for trial in asked])
        for trial, image in reversed(list(zip(asked, disks(X), strict=True))):
            if trial.number % 13 == 5:
                study.tell(trial, state=optuna.trial.TrialState.FAIL)
            else:
                study.tell(trial, sampler.tell_image(trial, image))
        params = json.dumps([trial.params for trial in asked])
        trace.note(candidates=X, params=params, best=repr(study.best_value))
    for sampler, study in zip(samplers, studies, strict=True):
        trace.note(counts=json.dumps(sampler.counts(study), sort_keys=True))


def command(trace: Trace, line: str) -> None:
    """`fide run ... --json`, in a process of its own."""
    arguments = [*line.split(), "--size", "32", "--json"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(
        [sys.executable, "-m", "fide_plugins", "run", *arguments],
        cwd=trace.folder,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    result = json.loads(done.stdout.splitlines()[-1])
    kept = ("seed", "task_seed", "dim", "evaluations", "best_loss", "mse", "x_best")
    trace.note(**{name: json.dumps(result[name]) for name in kept})
