"""One sampler in several studies, and studies that are mistaken for each other."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Callable, Iterator
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.storages import BaseStorage, InMemoryStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend

from fide_adapters.optuna import FIDESampler
from fide_adapters.optuna.settings import Settings
from fide_plugins import FIDE
from fide_plugins.types import Float64

from .conftest import Bench, counts_of

NAME = "demo"


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How many optimizers were made: two for each study, the first one for its first trial."""
    counted: Counter[str] = Counter()
    make = Settings.make

    @wraps(make)  # by its name a sampler is pickled
    def counting(*arguments: Any, **options: Any) -> FIDE:
        counted["optimizers"] += 1
        return make(*arguments, **options)

    monkeypatch.setattr(Settings, "make", counting)
    return counted


@pytest.fixture
def connect(tmp_path: Path) -> Iterator[Callable[[], RDBStorage]]:
    """Makes connections to one database."""
    made: list[RDBStorage] = []

    def connection() -> RDBStorage:
        made.append(RDBStorage(f"sqlite:///{tmp_path / 'studies.db'}"))
        return made[-1]

    yield connection
    for storage in made:
        storage.remove_session()
        storage.engine.dispose()


def demo(sampler: FIDESampler, storage: BaseStorage | None = None) -> optuna.Study:
    return optuna.create_study(
        study_name=NAME, storage=storage or InMemoryStorage(), sampler=sampler, load_if_exists=True
    )


def alone(bench: Bench, trials: int) -> Float64:
    """Points (trials, 5) that a sampler asks that is used once."""
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, trials)
    return bench.points(study)


# -- another study of the same name ----------------------------------------------------------------


@pytest.mark.parametrize("counted", [False, True])
@pytest.mark.parametrize("trials", [10, 60])
def test_a_pickled_sampler_in_a_new_study_of_that_name(
    bench: Bench, counted: bool, trials: int
) -> None:
    """Also where the new study has more trials by now than the pickled sampler has seen."""
    study = demo(bench.sampler())
    bench.run(study, 30)
    if counted:
        counts_of(study)
    sampler = pickle.loads(pickle.dumps(study.sampler))
    new = demo(bench.sampler())
    bench.run(new, trials)
    new.sampler = sampler
    with pytest.warns(RuntimeWarning, match="'demo' has other trials") as caught:
        bench.run(new, 60)
    assert len(caught) == 1
    counts = counts_of(new)
    assert counts["member"] + counts.get("altered", 0) == counts["image"] == 60 + trials


def test_a_pickled_sampler_begins_such_a_study_like_a_new_one(bench: Bench) -> None:
    study = demo(bench.sampler())
    for _ in range(100):  # the last trials of both studies have not begun
        study.enqueue_trial({})
    bench.run(study, 30)
    new = demo(pickle.loads(pickle.dumps(study.sampler)))
    for _ in range(100):
        new.enqueue_trial({})
    with pytest.warns(RuntimeWarning, match="'demo' has other trials"):
        bench.run(new, 40)
    np.testing.assert_array_equal(bench.points(new), alone(bench, 40))
    old = optuna.load_study(study_name=NAME, storage=study._storage, sampler=new.sampler)
    bench.run(old, 10)  # it still knows the one that it was pickled with
    np.testing.assert_array_equal(bench.points(old), alone(bench, 40))


@pytest.mark.thorough
@pytest.mark.parametrize("pickled", [False, True])
@pytest.mark.parametrize("reconnects", [False, True])
def test_a_study_that_was_deleted_and_made_again(
    bench: Bench, connect: Callable[[], RDBStorage], pickled: bool, reconnects: bool
) -> None:
    """The database gives it the same number."""
    storage = connect()
    study = demo(bench.sampler(), storage)
    bench.run(study, 8)
    sampler = bench.sampler_of(study)
    if pickled:
        sampler = pickle.loads(pickle.dumps(sampler))
    optuna.delete_study(study_name=NAME, storage=storage)
    again = demo(sampler, connect() if reconnects else study._storage)
    assert again._study_id == study._study_id
    if pickled or not reconnects:
        with pytest.warns(RuntimeWarning, match="'demo' has other trials"):
            bench.run(again, 8)
    else:  # the sampler might be used for a study of that name in two databases
        bench.run(again, 8)
    np.testing.assert_array_equal(bench.points(again), alone(bench, 8))
    assert counts_of(again) == {"member": 8, "image": 8}


def test_a_pickled_sampler_goes_on_in_its_database(
    bench: Bench, connect: Callable[[], RDBStorage], made: Counter[str]
) -> None:
    study = demo(bench.sampler(), connect())
    bench.run(study, 10)
    study.enqueue_trial(dict.fromkeys(bench.names, 0.5))
    later = demo(pickle.loads(pickle.dumps(study.sampler)), connect())
    before = made["optimizers"]
    bench.run(later, 10)
    assert made["optimizers"] == before  # nothing was processed again
    assert counts_of(later) == {"injected": 1, "member": 19, "image": 20}


# -- several studies in turn -----------------------------------------------------------------------


@pytest.mark.parametrize("names", [(None, None), (NAME, NAME), ("a", "b")])
def test_studies_in_turn_are_not_read_again(
    bench: Bench, made: Counter[str], names: tuple[str | None, str | None]
) -> None:
    sampler = bench.sampler()
    studies = [
        optuna.create_study(study_name=name, storage=InMemoryStorage(), sampler=sampler)
        for name in names
    ]
    for _ in range(30):
        for study in studies:
            bench.run(study, 1)
    assert made["optimizers"] == 4
    for study in studies:
        np.testing.assert_array_equal(bench.points(study), alone(bench, 30))
        assert counts_of(study) == {"member": 30, "image": 30}


@pytest.mark.parametrize("kind", ["database", "journal"])
def test_a_study_that_is_loaded_again_and_again_is_known(
    bench: Bench,
    made: Counter[str],
    connect: Callable[[], RDBStorage],
    tmp_path: Path,
    kind: str,
) -> None:
    sampler = bench.sampler()

    def storage() -> BaseStorage:
        if kind == "database":
            return connect()
        return JournalStorage(JournalFileBackend(str(tmp_path / "study.log")))

    for _ in range(6):
        study = demo(sampler, storage())
        bench.run(study, 2)
    assert made["optimizers"] == 2
    np.testing.assert_array_equal(bench.points(study), alone(bench, 12))
    assert counts_of(study) == {"member": 12, "image": 12}


def test_few_studies_are_kept(bench: Bench) -> None:
    sampler = bench.sampler()
    sizes = []
    for _ in range(8):
        study = optuna.create_study(sampler=sampler)
        bench.run(study, 10)
        sizes.append(len(pickle.dumps(sampler)))
    assert sizes[1] > 1.5 * sizes[0] and sizes[7] < 1.1 * sizes[3]
