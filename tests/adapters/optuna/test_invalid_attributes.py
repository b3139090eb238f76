"""A storage that anybody can write to: invalid attributes are ignored with one warning."""

from __future__ import annotations

import base64
import copy
import os
import pickle
import tempfile
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.trial import FrozenTrial, Trial, TrialState

from fide_adapters.optuna import FIDESampler

from .conftest import Bench, counts_of, with_attributes

CASES = int(os.environ.get("FIDE_CASES", "1"))  # times as many as in CI
FOLDER = Path(tempfile.mkdtemp())
RAN = FOLDER / "it-was-executed"
TARGET = np.full((4, 4, 3), 0.4, np.float32)
SPACE: dict[str, BaseDistribution] = {
    "kind": CategoricalDistribution(["a", "b", None]),
    "n": IntDistribution(1, 9),
    "x": FloatDistribution(-2.0, 3.0),
    "y": FloatDistribution(1e-3, 1.0, log=True),
}


class Payload:
    """What runs a command when it is unpickled."""

    def __reduce__(self) -> Any:
        return os.mkdir, (str(RAN),)


PICKLE = pickle.dumps(Payload())
CODE = f"__import__('os').mkdir({str(RAN)!r})"
ASKED: dict[str, Any] = {"v": 2, "optimizer": "x", "generation": 0, "slot": 0}
ODD: list[Any] = [
    None, True, -1, 0, 1, 7, 2**31, 2**53 - 1, 2**53, 2**70, -(2**70), 0.5, -0.0, 5e-324, 1e308,
    float("nan"), float("inf"), float("-inf"), "", "x", "AAAA", "0" * 100_000, "\ud800", "é\0",
    [], [0], [1, 2, 3], list(range(10_000)), ["x"], [[]], [None], {}, {"a": 1}, {"v": 2},
    ASKED, {"v": 2, "codec": "x", "code": "AAAA"},
    PICKLE.hex(), base64.b64encode(PICKLE).decode(), CODE, {"code": CODE}, [PICKLE.hex()],
]  # fmt: skip
KEYS = [
    "fide:ask", "fide:ask", "fide:image", "fide:image", "constraints", "constraints:a",
    "fide:seed", "fide:other", "fixed_params:x",
]  # fmt: skip

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=8,
)
anything = st.sampled_from(ODD) | json_values


def suggest(trial: Trial) -> dict[str, Any]:
    return {
        "kind": trial.suggest_categorical("kind", ["a", "b", None]),
        "n": trial.suggest_int("n", 1, 9),
        "x": trial.suggest_float("x", -2.0, 3.0),
        "y": trial.suggest_float("y", 1e-3, 1.0, log=True),
    }


def render(params: dict[str, Any]) -> Any:
    return np.broadcast_to((params["x"] + 2) / 5, (4, 4, 3)).astype(np.float32)


def sampler(seed: int | None) -> FIDESampler:
    return FIDESampler(TARGET, seed=seed, popsize=4)


def run(study: optuna.Study, trials: int) -> None:
    teller = study.sampler
    assert isinstance(teller, FIDESampler)
    for _ in range(trials):
        trial = study.ask()
        params = suggest(trial)
        assert all(
            SPACE[name]._contains(SPACE[name].to_internal_repr(v)) for name, v in params.items()
        )
        study.tell(trial, teller.tell_image(trial, render(params)))


def honest() -> list[FrozenTrial]:
    """Trials of a study that nobody has meddled with."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=sampler(0))
    run(study, 11)
    return study.get_trials()


HONEST = honest()


@st.composite
def meddled(draw: st.DrawFn) -> list[FrozenTrial]:
    """The same with something else in some attributes, or in a field of what is in them."""
    trials = copy.deepcopy(HONEST)
    for _ in range(draw(st.integers(1, 5))):
        attributes = draw(st.sampled_from(trials)).system_attrs
        key = draw(st.sampled_from(KEYS))
        record = attributes.get(key)
        if isinstance(record, dict) and draw(st.booleans()):
            field = draw(st.sampled_from([*record, "v", "began", "proposed", "skipped", "late"]))
            record[field] = draw(anything | st.lists(st.integers(0, 12), max_size=8))
        else:
            attributes[key] = draw(anything)
    for trial in trials:
        if draw(st.integers(0, 9)) == 0:
            trial.state = draw(st.sampled_from([TrialState.FAIL, TrialState.PRUNED]))
            trial.values = None
            trial.intermediate_values = {1: draw(st.floats())}
    return trials


@pytest.mark.thorough
@settings(max_examples=60 * CASES, deadline=None, suppress_health_check=list(HealthCheck))
@given(meddled(), st.none() | anything, st.sampled_from([None, 0]))
def test_whatever_is_in_the_storage_the_search_goes_on(
    trials: list[FrozenTrial], stored_seed: Any, seed: int | None
) -> None:
    """Parameters stay in their ranges, trials are counted, each subject is warned of once."""
    study = optuna.create_study(sampler=sampler(seed))
    study.add_trials(trials)
    if stored_seed is not None:
        study._storage.set_study_system_attr(study._study_id, "fide:seed", stored_seed)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run(study, 3)
        teller = study.sampler
        assert isinstance(teller, FIDESampler)
        counts = teller.counts(study)
    said = Counter(str(warning.message).split(" of trial")[0] for warning in caught)
    assert not said or max(said.values()) == 1
    assert all(issubclass(warning.category, RuntimeWarning) for warning in caught)
    roles = ("member", "altered", "late", "injected", "left out", "waiting")
    done = sum(t.state is TrialState.COMPLETE for t in study.trials)
    assert sum(counts.get(role, 0) for role in roles) >= done
    assert not RAN.exists()


# -- one at a time ---------------------------------------------------------------------------------


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
            with pytest.warns(RuntimeWarning, match="not a number") as caught:
                bench.run(study, 10)
            assert len(caught) == 1
            asked = bench.points(study)
        else:
            bench.run(study, 10)
            np.testing.assert_array_equal(bench.points(study), asked)


INVALID: list[Any] = [
    "text",
    {**ASKED, "v": 1},
    {**ASKED, "generation": -1},
    {**ASKED, "generation": 0.5},
    {**ASKED, "generation": True},
    {**ASKED, "optimizer": 3},
    {**ASKED, "skipped": "all"},
    {**ASKED, "late": list(range(1000))},
    {**ASKED, "skipped": [99]},
    {**ASKED, "slot": 10**30},
    {**ASKED, "guided": 1},
    {**ASKED, "problem": 3},
    {**ASKED, "more": 3},
    [1, 2, 3],
    None,
]


@pytest.mark.parametrize("record", INVALID)
@pytest.mark.parametrize("key", ["fide:ask", "fide:image"])
def test_invalid_attributes_are_ignored_with_one_warning(
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
    assert counts_of(study) == {"injected": 3, "member": 5, "image": 5}


@pytest.mark.parametrize("code", ["no code", "AAAA", 3, None, {"d": "AAAA"}])
def test_a_corrupt_code_counts_without_its_image(bench: Bench, code: Any) -> None:
    """As another worker would have left it, all but the code of the features."""
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, 5)
    good = study.trials[-1].system_attrs["fide:image"]
    study.add_trial(with_attributes(bench, {"fide:image": {**good, "code": code}}))
    with pytest.warns(RuntimeWarning, match="fide:image") as caught:
        bench.run(study, 5)
    assert len(caught) == 1
    assert counts_of(study) == {"injected": 1, "member": 10, "image": 10}


@pytest.mark.parametrize("seed", ["0", -1, 1.0, True, [0], 2**2000])
def test_a_seed_that_is_none_is_replaced_with_a_warning(bench: Bench, seed: Any) -> None:
    study = optuna.create_study(sampler=bench.sampler(seed=None))
    study._storage.set_study_system_attr(study._study_id, "fide:seed", seed)
    with pytest.warns(RuntimeWarning, match="fide:seed") as caught:
        bench.run(study, 3)
    assert len(caught) == 1
    stored = study._storage.get_study_system_attrs(study._study_id)["fide:seed"]
    assert type(stored) is int and stored >= 0
