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
sys.path.insert(0, str(Path(__file__).parents[3]))  # the repository

import optuna
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend

from tests.adapters.optuna.conftest import Bench

BENCH = Bench()


def open_storage(where: str) -> BaseStorage:
    """A journal file, or the URL of a database."""
    if "://" in where:
        return RDBStorage(where)
    return JournalStorage(JournalFileBackend(where))


def open_study(where: str) -> optuna.Study:
    """The study, with a new sampler."""
    sampler = BENCH.sampler(search_space=BENCH.space)
    return optuna.load_study(study_name="crowd", storage=open_storage(where), sampler=sampler)


def belief(study: optuna.Study) -> dict[str, Any]:
    """What a sampler has learned."""
    sampler = BENCH.sampler_of(study)
    counts = sampler.counts(study)
    optimizer = sampler._state_of(study).optimizer
    candidate = optimizer.replica.candidate(0).x.tolist()
    return {"counts": counts, "at": optimizer.at, "next": candidate, "pid": os.getpid()}


def work(worker: int, where: str, trials: int, folder: Path, dies: int) -> None:
    """Run so many trials."""
    study = open_study(where)
    objective_of_bench = BENCH.objective(BENCH.sampler_of(study))
    mine = 0

    def objective(trial: optuna.Trial) -> float:
        nonlocal mine
        loss: float = objective_of_bench(trial)
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
