"""A storage that anybody can write to: what is not ours is ignored with one warning, never run."""

from __future__ import annotations

import base64
import copy
import json
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
from optuna.artifacts import FileSystemArtifactStore
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.trial import FrozenTrial, Trial, TrialState

from fide_adapters.optuna import FIDESampler

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
ODD: list[Any] = [
    None, True, -1, 0, 1, 7, 2**31, 2**53 - 1, 2**53, 2**70, -(2**70), 0.5, -0.0, 5e-324, 1e308,
    float("nan"), float("inf"), float("-inf"), "", "x", "AAAA", "0" * 100_000, "\ud800", "é\0",
    [], [0], [1, 2, 3], list(range(10_000)), ["x"], [[]], [None], {}, {"a": 1}, {"v": 1},
    {"v": 1, "m": "x", "g": 0, "i": 0}, {"v": 1, "c": "x", "d": "AAAA"},
    PICKLE.hex(), base64.b64encode(PICKLE).decode(), CODE, {"d": CODE}, [PICKLE.hex()],
    json.dumps({"artifact_id": "../../etc/passwd", "filename": "x", "mimetype": "image/png",
                "encoding": None}),
    json.dumps({"artifact_id": 3, "filename": None, "mimetype": None, "encoding": None}),
    json.dumps({"artifact_id": "none", "filename": "x.png", "mimetype": "image/png",
                "encoding": None}),
]  # fmt: skip
KEYS = [
    "fide:ask", "fide:ask", "fide:image", "fide:image", "constraints", "constraints:a",
    "artifacts:00", "fide:seed", "fide:other", "fixed_params:x",
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
    store = FileSystemArtifactStore(FOLDER / "pictures")
    return FIDESampler(
        TARGET, seed=seed, popsize=4, artifact_store=store, consider_pruned_trials=True
    )


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
    (FOLDER / "pictures").mkdir()
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
            field = draw(st.sampled_from([*record, "v", "b", "p", "passed", "late"]))
            record[field] = draw(anything | st.lists(st.integers(0, 12), max_size=8))
        else:
            attributes[key] = draw(anything)
    for trial in trials:
        if draw(st.integers(0, 9)) == 0:
            trial.state = draw(st.sampled_from([TrialState.FAIL, TrialState.PRUNED]))
            trial.values = None
            trial.intermediate_values = {1: draw(st.floats())}
    return trials


@settings(max_examples=120 * CASES, deadline=None, suppress_health_check=list(HealthCheck))
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
    roles = ("member", "foreign", "late", "guest", "left out", "waiting")
    done = sum(t.state in (TrialState.COMPLETE, TrialState.PRUNED) for t in study.trials)
    assert sum(counts.get(role, 0) for role in roles) >= done
    assert not RAN.exists()


def test_the_payload_would_have_been_noticed() -> None:
    with pytest.raises(FileNotFoundError):
        RAN.rmdir()
    pickle.loads(PICKLE)
    RAN.rmdir()
