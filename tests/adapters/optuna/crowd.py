"""Worker processes on one study.

    python crowd.py WORKERS TRIALS DIES FOLDER STORAGE [FOLDER STORAGE ...]

Everything is imported once, then for each storage workers are forked, with a storage and a sampler
of their own; each runs so many trials.  Worker 0 is killed (SIGKILL) in the middle of its trial
number DIES, from 0.  When all others have finished, each writes what it believes into FOLDER.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import optuna
from optuna.distributions import FloatDistribution
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend

from fide_adapters.optuna import FIDESampler

NAMES = [f"x{i}" for i in range(5)]


def render(x: Any) -> Any:
    """Image (8, 8, 3) of a soft disk."""
    grid = (np.arange(8) + 0.5) / 8
    distance = np.hypot(grid[None, :] - x[0], grid[:, None] - x[1])
    inside = 1 / (1 + np.exp((distance - 0.3) * 15))
    return (inside[..., None] * np.asarray(x[2:5])).astype(np.float32)


TARGET = render([0.7, 0.35, 0.9, 0.4, 0.2])


def open_storage(where: str) -> BaseStorage:
    """A journal file, or the URL of a database."""
    if "://" in where:
        return RDBStorage(where)
    return JournalStorage(JournalFileBackend(where))


def open_study(where: str) -> optuna.Study:
    """The study, with a new sampler."""
    space = {name: FloatDistribution(0.0, 1.0) for name in NAMES}
    sampler = FIDESampler(TARGET, seed=0, popsize=6, search_space=space)
    return optuna.load_study(study_name="crowd", storage=open_storage(where), sampler=sampler)


def belief(study: optuna.Study) -> dict[str, Any]:
    """What a sampler has learned."""
    sampler = study.sampler
    assert isinstance(sampler, FIDESampler)
    counts = sampler.counts(study)
    optimizer = sampler._states.of(study).optimizer
    candidate = optimizer.replica.candidate(0).x.tolist()
    return {"counts": counts, "at": optimizer.at, "next": candidate, "pid": os.getpid()}


def work(worker: int, where: str, trials: int, folder: Path, dies: int) -> None:
    """Run so many trials."""
    study = open_study(where)
    sampler = study.sampler
    assert isinstance(sampler, FIDESampler)
    mine = 0

    def objective(trial: optuna.Trial) -> float:
        nonlocal mine
        loss = sampler.tell_image(trial, render([trial.suggest_float(n, 0, 1) for n in NAMES]))
        if worker == 0 and mine == dies:
            os.kill(os.getpid(), signal.SIGKILL)
        mine += 1
        return loss

    study.optimize(objective, n_trials=trials)
    (folder / f"finished-{worker}").touch()
    while not (folder / "go").exists():
        time.sleep(0.01)
    (folder / f"belief-{worker}.json").write_text(json.dumps(belief(study)))


def crowd(workers: int, trials: int, dies: int, folder: Path, where: str) -> None:
    """Fork workers and wait for them."""
    optuna.create_study(study_name="crowd", storage=open_storage(where))
    living = set()
    for worker in range(workers):
        pid = os.fork()
        if pid == 0:
            work(worker, where, trials, folder, dies)
            os._exit(0)
        living.add(pid)
    while len(list(folder.glob("finished-*"))) < len(living):
        pid, _ = os.waitpid(-1, os.WNOHANG)
        living.discard(pid)
        time.sleep(0.01)
    (folder / "go").touch()
    for pid in living:
        _, status = os.waitpid(pid, 0)
        if status:
            sys.exit(f"worker {pid} ended with status {status}")


def main() -> None:
    """One crowd after the other."""
    optuna.logging.set_verbosity(logging.WARNING)
    workers, trials, dies = map(int, sys.argv[1:4])
    for folder, where in zip(sys.argv[4::2], sys.argv[5::2], strict=True):
        crowd(workers, trials, dies, Path(folder), where)


if __name__ == "__main__":
    main()
