"""What a user may get wrong, and what somebody may have left in the storage."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.artifacts import FileSystemArtifactStore
from optuna.distributions import FloatDistribution
from optuna.trial import FrozenTrial
from PIL import Image

from fide_adapters.optuna import FIDESampler
from fide_plugins.errors import ImageError, OptionError, ProtocolError

from .conftest import Bench, counts_of

WRONG: dict[str, tuple[dict[str, Any], type[Exception], str]] = {
    "no image": ({"target": np.zeros((8, 8, 2))}, ImageError, "channels"),
    "preset": ({"preset": "best"}, OptionError, "preset"),
    "option": ({"colour": 3}, OptionError, "colour"),
    "popsize": ({"popsize": 1}, OptionError, "popsize"),
    "sigma0": ({"sigma0": 0}, OptionError, "sigma0"),
    "seed": ({"seed": -1}, OptionError, "seed"),
    "loss": ({"loss": "nice"}, OptionError, "nice"),
    "encoder": ({"encoder": "eye"}, OptionError, "eye"),
    "startup": ({"n_startup_trials": -1}, OptionError, "n_startup_trials"),
    "search space": ({"search_space": ["x"]}, OptionError, "search_space"),
    "search space of numbers": ({"search_space": {"x": (0, 1)}}, OptionError, "FloatDistribution"),
    "independent sampler": ({"independent_sampler": 3}, OptionError, "independent_sampler"),
    "loss without target": ({"target": None, "loss": "mse"}, OptionError, "target"),
}


def with_attributes(bench: Bench, attributes: dict[str, Any], value: float = 0.5) -> FrozenTrial:
    """A completed trial of the bench's space, with what may be stored beside it."""
    return optuna.create_trial(
        params=dict.fromkeys(bench.names, 0.5),
        distributions=bench.space,
        value=value,
        system_attrs=attributes,
    )


@pytest.mark.parametrize("what", WRONG)
def test_wrong_settings(bench: Bench, what: str) -> None:
    settings, error, message = WRONG[what]
    with pytest.raises(error, match=message) as caught:
        bench.sampler(**settings)
    assert isinstance(caught.value, ValueError)


def test_images_need_a_target(bench: Bench) -> None:
    sampler = FIDESampler()
    study = optuna.create_study(sampler=sampler)
    trial = study.ask()
    with pytest.raises(ProtocolError, match="target=") as caught:
        sampler.tell_image(trial, bench.target)
    assert isinstance(caught.value, RuntimeError)


def test_without_a_target_it_says_once_that_it_is_cma_es(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    study = optuna.create_study(sampler=FIDESampler())
    study.optimize(lambda trial: sum(bench.suggest(trial)), n_trials=10)
    assert [r.message for r in caplog.records if "CMA-ES" in r.message] == [
        "FIDESampler without a target is CMA-ES"
    ]


def test_a_search_space_that_promises_too_much_is_warned_of_once(bench: Bench) -> None:
    space = {**bench.space, "never": FloatDistribution(0.0, 1.0)}
    study = optuna.create_study(sampler=bench.sampler(search_space=space))
    with pytest.warns(RuntimeWarning, match="has no never, which search_space names") as caught:
        bench.run(study, 5)
    assert len(caught) == 1
    assert counts_of(study) == {"left out": 5}


@pytest.mark.parametrize(
    ("attributes", "as_if"),
    [
        ({"constraints": [-1.0, "high"]}, []),
        ({"constraints": "high"}, []),
        ({"constraints:a": {"b": 1}}, []),
        ({"constraints:a": None, "constraints:b": np.float32(2.0)}, [2.0]),
        ({"constraints": "high", "constraints:b": 10**400}, [1e300]),
    ],
)
def test_a_constraint_that_is_no_number_is_ignored_with_a_warning(
    bench: Bench, attributes: dict[str, Any], as_if: list[float]
) -> None:
    samplers = [bench.sampler(), bench.sampler()]
    for sampler, stored in zip(samplers, (attributes, {"constraints": as_if}), strict=True):
        study = optuna.create_study(sampler=sampler)
        bench.run(study, 5)
        study.add_trial(with_attributes(bench, stored, value=0.0))
        if stored is attributes:
            with pytest.warns(RuntimeWarning, match="no number") as caught:
                bench.run(study, 10)
            assert len(caught) == 1
            asked = bench.points(study)
        else:
            bench.run(study, 10)
            np.testing.assert_array_equal(bench.points(study), asked)


@pytest.mark.parametrize(
    "stored",
    [
        "no json",
        None,
        '{"artifact_id": "a"}',
        '{"artifact_id": "a", "filename": "a", "mimetype": null, "encoding": null}',
        '{"artifact_id": 3, "filename": "a", "mimetype": "image/png", "encoding": null}',
        '{"artifact_id": "../a", "filename": "a", "mimetype": "image/png", "encoding": null}',
    ],
)
def test_a_note_of_an_artifact_that_is_none_is_ignored(
    bench: Bench, stored: Any, tmp_path: Path
) -> None:
    """Nor is a picture read that is outside of the store."""
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "a", "PNG")
    (tmp_path / "store").mkdir()
    store = FileSystemArtifactStore(tmp_path / "store")
    study = optuna.create_study(sampler=bench.sampler(artifact_store=store))
    study.add_trial(with_attributes(bench, {"artifacts:a": stored}))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        bench.run(study, 5)
    is_no_image = isinstance(stored, str) and 'null, "enc' in stored
    assert [str(w.message)[:21] for w in caught] == ["the image of trial 0 "] * (not is_no_image)
    assert counts_of(study) == {"guest": 1, "member": 5, "image": 5}


FOREIGN: list[Any] = [
    "text",
    {"v": 2, "m": "x", "g": 0, "i": 0},
    {"v": 1, "m": "x", "g": -1, "i": 0},
    {"v": 1, "m": "x", "g": 0.5, "i": 0},
    {"v": 1, "m": "x", "g": True, "i": 0},
    {"v": 1, "m": 3, "g": 0, "i": 0},
    {"v": 1, "m": "x", "g": 0, "i": 0, "passed": "all"},
    {"v": 1, "m": "x", "g": 0, "i": 0, "late": list(range(1000))},
    {"v": 1, "m": "x", "g": 0, "i": 10**30},
    [1, 2, 3],
    None,
]


@pytest.mark.parametrize("record", FOREIGN)
@pytest.mark.parametrize("key", ["fide:ask", "fide:image"])
def test_foreign_attributes_are_ignored_with_one_warning(
    bench: Bench, key: str, record: Any
) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    for _ in range(3):
        study.add_trial(with_attributes(bench, {key: record}))
    if record is None:
        bench.run(study, 5)
    else:
        with pytest.warns(RuntimeWarning, match=key) as caught:
            bench.run(study, 5)
        assert len(caught) == 1
    assert counts_of(study) == {"guest": 3, "member": 5, "image": 5}


@pytest.mark.parametrize("code", ["no code", "AAAA", 3, None, {"d": "AAAA"}])
def test_a_corrupt_code_counts_without_its_image(bench: Bench, code: Any) -> None:
    """As another worker would have left it, all but the code of the features."""
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, 5)
    good = study.trials[-1].system_attrs["fide:image"]
    study.add_trial(with_attributes(bench, {"fide:image": {**good, "d": code}}))
    with pytest.warns(RuntimeWarning, match="fide:image") as caught:
        bench.run(study, 5)
    assert len(caught) == 1
    assert counts_of(study) == {"guest": 1, "member": 10, "image": 10}


@pytest.mark.parametrize("seed", ["0", -1, 1.0, True, [0], 2**2000])
def test_a_seed_that_is_none_is_replaced_with_a_warning(bench: Bench, seed: Any) -> None:
    study = optuna.create_study(sampler=bench.sampler(seed=None))
    study._storage.set_study_system_attr(study._study_id, "fide:seed", seed)
    with pytest.warns(RuntimeWarning, match="fide:seed") as caught:
        bench.run(study, 3)
    assert len(caught) == 1
    stored = study._storage.get_study_system_attrs(study._study_id)["fide:seed"]
    assert type(stored) is int and stored >= 0


def test_records_that_name_trials_that_cannot_be_meant(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    ask = {"v": 1, "m": "x", "g": 0, "i": 0, "passed": [0, 99], "late": [1, 5, 2**40]}
    study.add_trial(with_attributes(bench, {"fide:ask": ask}))
    bench.run(study, 10)
    assert counts_of(study) == {"guest": 1, "member": 10, "image": 10}


def test_it_is_found_where_the_optimizer_is() -> None:
    import fide_plugins

    assert fide_plugins.FIDESampler is FIDESampler
