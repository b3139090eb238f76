"""Optuna finds eight Voronoi cells: FIDE changes one line of the study and one of the objective."""

from __future__ import annotations

import numpy as np
import optuna

import fide_tasks
from fide_adapters.optuna import FIDESampler

optuna.logging.set_verbosity(optuna.logging.WARNING)
task = fide_tasks.make("voronoi", size=64, seed=0)  # 40 parameters in [0, 1]
TRIALS = 600


def draw(trial: optuna.Trial) -> np.ndarray:
    x = [trial.suggest_float(f"x{i}", 0, 1) for i in range(task.dim)]
    image: np.ndarray = task.render(np.array([x]))[0]
    return image


def fit(sampler: optuna.samplers.BaseSampler, judge: FIDESampler) -> float:
    study = optuna.create_study(sampler=sampler)
    study.optimize(lambda trial: judge.tell_image(trial, draw(trial)), n_trials=TRIALS)
    return study.best_value


def main() -> None:
    sampler = FIDESampler(task.target, seed=0)
    found = fit(sampler, sampler)
    guessed = fit(optuna.samplers.RandomSampler(seed=0), FIDESampler(task.target))
    print(f"mean squared error after {TRIALS} trials: {found:.4f}, at random {guessed:.4f}")


if __name__ == "__main__":
    main()
