"""How long workers wait for trials that never finish, and for those of slow workers."""

from __future__ import annotations

import heapq
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import optuna
import pytest
from optuna.trial import FrozenTrial, TrialState

from fide_adapters.optuna.storage import WarnOnce
from fide_adapters.optuna.trials import History, TrialOrder

from .conftest import Bench, counts_of

GENERATION = 8
BEGAN = datetime(2026, 1, 1)


def running(number: int, seconds: float, zone: timezone | None = None) -> FrozenTrial:
    return FrozenTrial(
        number=number,
        trial_id=number,
        state=TrialState.RUNNING,
        value=None,
        datetime_start=(BEGAN + timedelta(seconds=seconds)).replace(tzinfo=zone),
        datetime_complete=None,
        params={},
        distributions={},
        user_attrs={},
        system_attrs={},
        intermediate_values={},
    )


def complete(trial: FrozenTrial, seconds: float) -> None:
    trial.state, trial.value = TrialState.COMPLETE, 0.0
    assert trial.datetime_start is not None
    zone = trial.datetime_start.tzinfo
    trial.datetime_complete = (BEGAN + timedelta(seconds=seconds)).replace(tzinfo=zone)


def skipped(workers: int, trials: int, spread: float, dies: float, seed: int = 0) -> list[bool]:
    """Whether each trial that is skipped is dead; a worker that dies is replaced at once.

    spread: standard deviation of the logarithm of the seconds that a trial takes.
    """
    rng = np.random.default_rng(seed)
    order = TrialOrder(history := History(WarnOnce()))
    study: list[FrozenTrial] = []
    dead: list[bool] = []
    busy: list[tuple[float, int]] = []

    def begin(now: float) -> None:
        heapq.heappush(busy, (now + rng.lognormal(0.0, spread), len(study)))
        study.append(running(len(study), now))
        dead.append(bool(rng.random() < dies))

    for _ in range(workers):
        begin(0.0)
    while len(study) < trials:
        now, number = heapq.heappop(busy)
        if not dead[number]:
            complete(study[number], now)
        begin(now)
        list(order.processable(study))
        history.skip(order.overdue(study, GENERATION))
    return [dead[number] for number in history.skipped]


@pytest.mark.thorough
@pytest.mark.parametrize("dies", [0.0, 0.25])
def test_a_hundred_workers_are_waited_for(dies: float) -> None:
    found = skipped(100, 1500, 0.3, dies)
    assert all(found)
    assert len(found) > 100 if dies else not found


def test_times_of_another_zone_and_none_at_all_are_survived() -> None:
    study = [running(i, i, UTC if i % 2 else None) for i in range(40)]
    for trial in study[1:]:
        complete(trial, trial.number + 0.5)
    study[3].datetime_start = None
    assert TrialOrder(History(WarnOnce())).overdue(study, GENERATION) == [0]


def test_one_worker_learns_beside_many_that_were_killed(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, 12)
    for _ in range(32):
        bench.suggest(study.ask())
    bench.run(study, 60)
    counts = counts_of(study)
    assert counts["image"] == 72 and "waiting" not in counts
