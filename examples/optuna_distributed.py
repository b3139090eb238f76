"""Four worker processes on one study; one is killed in the middle, and nothing is lost.

Workers share a file and nothing else.  On several machines it would be the URL of a database.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from pathlib import Path

import numpy as np
import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

import fide_tasks
from fide_adapters.optuna import FIDESampler, image_objective

WORKERS, TRIALS = 4, 60


def open_study(path: str) -> optuna.Study:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    task = fide_tasks.make("voronoi", size=64, seed=0)
    return optuna.create_study(
        study_name="voronoi",
        storage=JournalStorage(JournalFileBackend(path)),
        sampler=FIDESampler(task.target, seed=0),  # the same settings for every worker
        load_if_exists=True,
    )


def work(path: str) -> None:
    task = fide_tasks.make("voronoi", size=64, seed=0)

    def render(trial: optuna.Trial) -> np.ndarray:
        x = [trial.suggest_float(f"x{i}", 0, 1) for i in range(task.dim)]
        image: np.ndarray = task.render(np.array([x]))[0]
        return image

    open_study(path).optimize(image_objective(render), n_trials=TRIALS)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder, "study.log"))
        open_study(path)
        context = multiprocessing.get_context("spawn")
        workers = [context.Process(target=work, args=(path,)) for _ in range(WORKERS)]
        for worker in workers:
            worker.start()
        study = open_study(path)
        while len(study.get_trials(deepcopy=False)) < TRIALS:
            time.sleep(0.1)
        workers[0].kill()
        for worker in workers:
            worker.join()
        states = [trial.state.name for trial in study.get_trials(deepcopy=False)]
        sampler = study.sampler
        assert isinstance(sampler, FIDESampler)
        print({state: states.count(state) for state in sorted(set(states))})
        work(path)  # one more worker, who was not there: it catches up from the file
        print("they counted as", sampler.counts(study), "best", study.best_value)


if __name__ == "__main__":
    main()
