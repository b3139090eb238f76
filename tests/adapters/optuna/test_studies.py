"""One sampler in several studies, and studies that are mistaken for each other."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import optuna
import pytest
from optuna.storages import BaseStorage, InMemoryStorage, RDBStorage

from fide_adapters.optuna import FIDESampler
from fide_plugins.types import Float64

from .conftest import Bench, counts_of


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
    """The study of one name, and of one number: the first of its storage."""
    return optuna.create_study(
        study_name="demo",
        storage=storage or InMemoryStorage(),
        sampler=sampler,
        load_if_exists=True,
    )


def alone(bench: Bench, trials: int) -> Float64:
    """Points (trials, 5) that a sampler asks that is used once."""
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, trials)
    return bench.points(study)


@pytest.mark.parametrize("trials", [10, 60])
def test_a_pickled_sampler_in_a_new_study_of_that_name(bench: Bench, trials: int) -> None:
    """Also where the new study has more trials by now than the pickled sampler has seen."""
    study = demo(bench.sampler())
    bench.run(study, 30)
    sampler = pickle.loads(pickle.dumps(study.sampler))
    new = demo(bench.sampler())
    bench.run(new, trials)
    new.sampler = sampler
    bench.run(new, 60)
    counts = counts_of(new)
    assert counts["member"] + counts.get("altered", 0) == counts["image"] == 60 + trials


@pytest.mark.parametrize("pickled", [False, True])
def test_a_study_that_was_deleted_and_made_again(
    bench: Bench, connect: Callable[[], RDBStorage], pickled: bool
) -> None:
    """The database gives it the same number."""
    storage = connect()
    study = demo(bench.sampler(), storage)
    bench.run(study, 8)
    sampler = bench.sampler_of(study)
    if pickled:
        sampler = pickle.loads(pickle.dumps(sampler))
    optuna.delete_study(study_name="demo", storage=storage)
    again = demo(sampler, connect())
    assert again._study_id == study._study_id
    bench.run(again, 8)
    np.testing.assert_array_equal(bench.points(again), alone(bench, 8))
    assert counts_of(again) == {"member": 8, "image": 8}


@pytest.mark.parametrize("pickled", [False, True])
def test_a_sampler_goes_on_through_another_connection(
    bench: Bench, connect: Callable[[], RDBStorage], pickled: bool
) -> None:
    """With its features in full precision: nothing was processed again."""
    study = demo(bench.sampler(), connect())
    bench.run(study, 10)
    sampler = bench.sampler_of(study)
    later = demo(pickle.loads(pickle.dumps(sampler)) if pickled else sampler, connect())
    bench.run(later, 10)
    assert counts_of(later) == {"member": 20, "image": 20}
    np.testing.assert_array_equal(bench.points(later), alone(bench, 20))
