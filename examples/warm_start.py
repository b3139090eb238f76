"""Continue a study that another sampler began: FIDE learns from its trials, too."""

from __future__ import annotations

import numpy as np
import optuna

import fide_tasks
from fide_adapters.optuna import FIDESampler, image_objective

optuna.logging.set_verbosity(optuna.logging.WARNING)
task = fide_tasks.make("voronoi", size=64, seed=0)


def render(trial: optuna.Trial) -> np.ndarray:
    x = [trial.suggest_float(f"x{i}", 0, 1) for i in range(task.dim)]
    image: np.ndarray = task.render(np.array([x]))[0]
    return image


def objective(trial: optuna.Trial) -> float:  # the original one, without FIDE
    return float(np.square(render(trial) - task.target).mean())


def main() -> None:
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0))
    study.optimize(objective, n_trials=100)
    print(f"TPE, 100 trials: {study.best_value:.4f}")
    sampler = FIDESampler(task.target, seed=0)
    study.sampler = sampler
    study.optimize(image_objective(render), n_trials=300)
    print(f"FIDE, 300 more: {study.best_value:.4f}; counted as {sampler.counts(study)}")


if __name__ == "__main__":
    main()
