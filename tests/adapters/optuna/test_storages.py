"""Storages, threads, artifacts, and what is kept where (acceptance points 5, 6, 7, 15, 16)."""

from __future__ import annotations

import json
import pickle
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.artifacts import FileSystemArtifactStore, get_all_artifact_meta, upload_artifact
from optuna.samplers import RandomSampler
from optuna.storages import InMemoryStorage
from optuna.testing.storages import STORAGE_MODES, StorageSupplier
from optuna.trial import FrozenTrial, Trial, TrialState
from PIL import Image

from fide_adapters.optuna import FIDESampler
from fide_adapters.optuna_parts.records import MOST_NAMED, Ask, write_image

from .conftest import Bench


@pytest.fixture(scope="module")
def in_memory() -> list[dict[str, Any]]:
    return params_in(optuna.storages.InMemoryStorage())


def params_in(storage: Any) -> list[dict[str, Any]]:
    sampler = FIDESampler(np.linspace(0, 1, 64).reshape(8, 8), seed=0, popsize=4)
    study = optuna.create_study(storage=storage, sampler=sampler)

    def objective(trial: Trial) -> float:
        x = trial.suggest_float("x", -1, 1)
        k = trial.suggest_int("k", 1, 1000, log=True)
        trial.suggest_categorical("c", ["a", "b", "c"])
        return sampler.tell_image(trial, np.full((8, 8), abs(x) * k / 1000))

    study.optimize(objective, n_trials=14)
    assert sampler.counts(study) == {"guest": 1, "member": 13, "image": 14}
    return [trial.params for trial in study.trials]


@pytest.mark.parametrize("mode", STORAGE_MODES)
def test_point_5_every_storage_gives_the_same(mode: str, in_memory: list[dict[str, Any]]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # those of the storages themselves
        with StorageSupplier(mode) as storage:
            assert params_in(storage) == in_memory


def size_of(attributes: dict[str, Any]) -> int:
    ours = {key: value for key, value in attributes.items() if key.startswith("fide:")}
    assert len(ours) == len(attributes)
    assert all(len(json.dumps(value)) <= 2045 for value in ours.values())
    return sum(len(key) + len(json.dumps(value)) for key, value in ours.items())


def test_point_6_two_kibibytes_a_trial_at_200_dimensions() -> None:
    target = np.random.default_rng(0).random((112, 112, 3))
    sampler = FIDESampler(target, seed=0)
    study = optuna.create_study(sampler=sampler)

    def objective(trial: Trial) -> float:
        x = [trial.suggest_float(f"x{i}", 0, 1) for i in range(200)]
        return sampler.tell_image(trial, np.random.default_rng(int(1e9 * x[0])).random((112, 112)))

    study.optimize(objective, n_trials=8)
    sizes = [size_of(trial.system_attrs) for trial in study.trials]
    assert max(sizes) <= 2048
    code = study.trials[-1].system_attrs["fide:image"]["d"]
    numbers = tuple(range(10**6 - MOST_NAMED, 10**6))
    worst = Ask("0" * 8, 10**6, 2 * 10**6, 10**6, True, numbers, numbers).to_json()
    assert size_of({"fide:ask": worst, "fide:image": write_image("0" * 8, code)}) <= 2048
    assert not study._storage.get_study_system_attrs(study._study_id)


def test_point_7_eight_threads(bench: Bench) -> None:
    sampler = bench.sampler()
    study = optuna.create_study(sampler=sampler)
    bench.run(study, 120, n_jobs=8)
    assert all(t.state is TrialState.COMPLETE for t in study.trials)
    eye, memory = sampler._settings.eye, sampler._memory
    assert eye is not None and memory is not None
    for trial in study.trials:  # every feature belongs to its own trial
        image = bench.render([trial.params[name] for name in bench.names])
        code = trial.system_attrs["fide:image"]["d"]
        assert code == eye.codec.pack(eye.tokens(image[None]))
    counts = sampler.counts(study)
    assert counts["image"] == 120
    assert sum(counts.values()) - counts["image"] == 120
    assert not memory.tokens and not sampler._settings.voice._said
    X = bench.points(study)
    assert len(np.unique(X, axis=0)) == 120


class Counting(list[FrozenTrial]):
    """A list that counts how often it is looked into."""

    looks = 0

    def __getitem__(self, index: Any) -> Any:
        Counting.looks += 1
        return super().__getitem__(index)

    def __iter__(self) -> Any:
        raise AssertionError("nobody looks at all trials")


class Elsewhere:
    """A storage that is not known to be in memory."""

    def __init__(self) -> None:
        self._real = InMemoryStorage()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)

    def get_all_trials(self, study_id: int, deepcopy: bool = True, states: Any = None) -> Any:
        trials = self._real.get_all_trials(study_id, deepcopy, states)
        return trials if states else Counting(trials)


class InMemory(InMemoryStorage):
    """The one that is, which nobody asks for all trials."""

    def get_all_trials(self, study_id: int, deepcopy: bool = True, states: Any = None) -> Any:
        assert states is not None, "nobody looks at all trials"
        return super().get_all_trials(study_id, deepcopy, states)

    def get_trial(self, trial_id: int) -> FrozenTrial:
        Counting.looks += 1
        return super().get_trial(trial_id)


@pytest.mark.parametrize("make", [Elsewhere, InMemory])
def test_point_15_no_trial_is_looked_at_for_ever(bench: Bench, make: Callable[[], Any]) -> None:
    sampler = bench.sampler(search_space=bench.space)
    study = optuna.create_study(storage=make(), sampler=sampler)
    looks = []
    for _ in range(3):
        Counting.looks = 0
        bench.run(study, 60)
        looks.append(Counting.looks)
    assert 60 <= looks[0] <= 60 * 30 and looks[2] <= looks[0] + 20


def test_point_15_finished_trials_are_not_touched(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, 20)
    before = pickle.dumps(study.get_trials(deepcopy=False))
    bench.run(study, 20)
    study.sampler.reseed_rng()
    assert pickle.dumps(study.get_trials(deepcopy=False)[:20]) == before


# -- point 16: artifacts ---------------------------------------------------------------------------


def test_point_16_pictures_are_kept_and_shown(bench: Bench, tmp_path: Path) -> None:
    store = FileSystemArtifactStore(str(tmp_path))
    study = optuna.create_study(sampler=bench.sampler(artifact_store=store))
    bench.run(study, 5)
    for trial in study.trials:
        (meta,) = get_all_artifact_meta(trial, storage=study._storage)
        assert (meta.mimetype, meta.filename) == ("image/png", "image.png")
        with store.open_reader(meta.artifact_id) as reader:
            pixels = np.asarray(Image.open(reader))
        image = bench.render([trial.params[name] for name in bench.names])
        np.testing.assert_array_equal(pixels, np.round(image * 255))


def upload(trial: Any, study: optuna.Study, store: Any, image: Any, folder: Path) -> None:
    path = folder / f"{trial.number}.png"
    Image.fromarray(np.round(image * 255).astype(np.uint8)).save(path)
    upload_artifact(
        artifact_store=store, file_path=str(path), study_or_trial=trial, storage=study._storage
    )


def test_point_16_an_artifact_of_the_objective_is_seen(bench: Bench, tmp_path: Path) -> None:
    store = FileSystemArtifactStore(str(tmp_path))
    study = optuna.create_study(sampler=bench.sampler(artifact_store=store))

    def objective(trial: Trial) -> float:
        image = bench.render(bench.suggest(trial))
        upload(trial, study, store, image, tmp_path)
        return float(np.square(image - bench.target).mean())

    study.optimize(objective, n_trials=10)
    assert bench.sampler_of(study).counts(study)["image"] == 10
    study.sampler = bench.sampler()  # who has no store learns from what was recorded
    assert "fide:image" in study.trials[3].system_attrs
    bench.run(study, 1)
    assert bench.sampler_of(study).counts(study)["image"] == 11


def test_point_16_artifacts_of_another_sampler_s_trials(bench: Bench, tmp_path: Path) -> None:
    """Of three, one picture was lost and one is no picture: one warning, all three count."""
    store = FileSystemArtifactStore(str(tmp_path / "store"))
    (tmp_path / "store").mkdir()
    study = optuna.create_study(sampler=RandomSampler(seed=0))

    def objective(trial: Trial) -> float:
        image = bench.render(bench.suggest(trial))
        upload(trial, study, store, image, tmp_path)
        return float(np.square(image - bench.target).mean())

    study.optimize(objective, n_trials=4)
    ids = [
        get_all_artifact_meta(trial, storage=study._storage)[0].artifact_id
        for trial in study.trials
    ]
    store.remove(ids[1])
    (tmp_path / "store" / ids[2]).write_bytes(b"\x89PNG no longer")
    study.sampler = bench.sampler(artifact_store=store)
    with pytest.warns(RuntimeWarning, match="counts without it") as caught:
        bench.run(study, 3)
    assert len(caught) == 1
    counts = bench.sampler_of(study).counts(study)
    assert counts == {"guest": 4, "member": 3, "image": 5}
