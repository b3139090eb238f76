"""Four worker processes on one study; one is killed during a trial, and nothing is lost.

The workers share only a file.  On several machines, use the URL of a database instead.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
from pathlib import Path

import numpy as np
import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

import fide_tasks
from fide_adapters.optuna import FIDESampler, image_objective

WORKERS, TRIALS = 4, 24
optuna.logging.set_verbosity(optuna.logging.WARNING)
task = fide_tasks.make("voronoi", cells=4, size=64, seed=0)  # 20 parameters


def open_study(path: str) -> tuple[optuna.Study, FIDESampler]:
    sampler = FIDESampler(task.target, seed=0)  # every worker needs the same options
    storage = JournalStorage(JournalFileBackend(path))
    study = optuna.create_study(
        study_name="voronoi", storage=storage, sampler=sampler, load_if_exists=True
    )
    return study, sampler


def work(path: str, doomed: bool = False) -> None:
    def render(trial: optuna.Trial) -> np.ndarray:
        x = [trial.suggest_float(f"x{i}", 0, 1) for i in range(task.dim)]
        if doomed and trial.number >= TRIALS:
            os.kill(os.getpid(), signal.SIGKILL)
        image: np.ndarray = task.render(np.array([x]))[0]
        return image

    study, _ = open_study(path)
    study.optimize(image_objective(render), n_trials=TRIALS)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder, "study.log"))
        study, sampler = open_study(path)
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["fide_adapters.optuna", "fide_tasks"])  # imported once
        workers = [context.Process(target=work, args=(path, i == 0)) for i in range(WORKERS)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        work(path)  # a new worker: it reads the study from the file
        states = [trial.state.name for trial in study.get_trials(deepcopy=False)]
        print({state: states.count(state) for state in sorted(set(states))})
        print(f"they counted as {sampler.counts(study)}; least loss {study.best_value:.4f}")


if __name__ == "__main__":
    main()
