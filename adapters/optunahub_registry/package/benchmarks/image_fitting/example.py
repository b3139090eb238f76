from __future__ import annotations

import optuna
import optunahub


problem = optunahub.load_module(package="benchmarks/image_fitting").Problem("sprites", number=0)

if __name__ == "__main__":
    study = optuna.create_study(sampler=optuna.samplers.CmaEsSampler(seed=0))
    study.optimize(problem, n_trials=100)
    print(study.best_value, "solved" if study.best_value <= problem.solved else "not solved")
