"""One sampler, one process: what it asks, and what it makes of what it is told.

The numbers are those of the acceptance points that a reviewer from Optuna would check.
"""

from __future__ import annotations

import copy
import gc
import json
import logging
import os
import pickle
import subprocess
import sys
import warnings
import weakref
from typing import Any, TypeAlias

import numpy as np
import optuna
import pytest
import torch
from optuna.distributions import FloatDistribution
from optuna.samplers import PartialFixedSampler, RandomSampler
from optuna.trial import FixedTrial, Trial, TrialState
from PIL import Image

from fide_adapters.optuna import FIDESampler, ImageLoss, ImageRef, image_objective
from fide_plugins import FIDE, encoders
from fide_plugins.errors import FeaturesError, ImageError, LossError, OptionError, ProtocolError
from fide_plugins.points import Float64

Bench: TypeAlias = Any


def counts_of(study: optuna.Study) -> dict[str, int]:
    sampler = study.sampler
    assert isinstance(sampler, FIDESampler)
    return sampler.counts(study)


def asked_by_core(bench: Bench, trials: int, **settings: Any) -> Float64:
    """Candidates (n, 5) of the core, told one by one."""
    core = FIDE(5, bench.target, **{"seed": 0, "popsize": 6, **settings})
    asked = []
    while core.evaluations < trials:
        x = core.ask(1)
        asked.append(x[0])
        core.tell(x, bench.render(x[0])[None])
    return np.array(asked)


# -- point 4: the same everywhere ------------------------------------------------------------------


@pytest.mark.parametrize("preset", ["fast", "balanced", "accurate"])
def test_point_4_one_worker_asks_what_the_core_asks(bench: Bench, preset: str) -> None:
    settings = {"preset": preset, "patience": 2}  # so little that it relocates
    study = optuna.create_study(sampler=bench.sampler(search_space=bench.space, **settings))
    bench.run(study, 150)
    np.testing.assert_array_equal(bench.points(study), asked_by_core(bench, 150, **settings))
    assert counts_of(study) == {"member": 150, "image": 150}


@pytest.mark.parametrize("names", [[f"x{i}" for i in range(12)], ["a", "b", "c"]])
def test_point_4_without_a_given_space_it_is_the_same(bench: Bench, names: list[str]) -> None:
    """The first trial is rounded otherwise by a bit at most; from the second on all are equal."""
    sampler: FIDESampler = bench.sampler(popsize=None)
    study = optuna.create_study(sampler=sampler)

    def objective(trial: Trial) -> float:
        x = [trial.suggest_float(name, 0, 1) for name in names]
        return sampler.tell_image(trial, bench.render(np.resize(x, 5)))

    study.optimize(objective, n_trials=60)
    core = FIDE(len(names), bench.target, seed=0)
    for trial in study.trials:
        x = core.ask(1)
        asked = [trial.params[name] for name in names]
        np.testing.assert_allclose(asked, x[0], rtol=0, atol=0 if trial.number else 1e-15)
        core.tell(x, bench.render(np.resize(x[0], 5))[None])
    assert sampler.counts(study) == {"member": 60, "image": 60}


@pytest.mark.parametrize("target", [True, False])
def test_point_4_without_images_it_is_cma_es(bench: Bench, target: bool) -> None:
    def sphere(trial: Trial) -> float:
        return float(((np.array(bench.suggest(trial)) - 0.3) ** 2).sum())

    settings: dict[str, Any] = {} if target else {"target": None}
    study = optuna.create_study(sampler=bench.sampler(search_space=bench.space, **settings))
    study.optimize(sphere, n_trials=120)
    core = FIDE(5, bench.target, seed=0, popsize=6, proposer="none")
    for x in bench.points(study):
        np.testing.assert_array_equal(core.ask(1)[0], x)
        core.tell(x[None], losses=[((x - 0.3) ** 2).sum()])


def test_point_4_same_seed_same_study(bench: Bench) -> None:
    runs = []
    for seed in (0, 0, 1):
        study = optuna.create_study(sampler=bench.sampler(seed=seed))
        bench.run(study, 40)
        runs.append(bench.points(study))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert (runs[0] != runs[2]).any(axis=1).all()


# -- points 2 and 3: seeds, copies -----------------------------------------------------------------


def mixed(trial: Trial) -> float:
    return float(
        trial.suggest_float("a", 1, 9)
        + trial.suggest_float("b", 1, 9, log=True)
        + trial.suggest_float("c", 1, 9, step=1)
        + trial.suggest_int("d", 1, 9)
        + trial.suggest_int("e", 1, 9, log=True)
        + trial.suggest_int("f", 1, 9, step=2)
        + trial.suggest_categorical("g", range(1, 10))
    )


def params_of(sampler: FIDESampler, constant: bool = False) -> list[dict[str, Any]]:
    study = optuna.create_study(sampler=sampler)
    study.optimize(lambda trial: 0.0 * mixed(trial) if constant else mixed(trial), n_trials=15)
    return [trial.params for trial in study.trials]


@pytest.mark.parametrize("constant", [False, True])
def test_point_2_reproducible(constant: bool) -> None:
    first = params_of(FIDESampler(seed=1), constant)
    assert params_of(FIDESampler(seed=1), constant) == first
    assert params_of(FIDESampler(seed=2), constant) != first


def test_point_2_reseeding_changes_what_is_sampled() -> None:
    sampler = FIDESampler(seed=1)
    sampler.reseed_rng()
    assert params_of(sampler) != params_of(FIDESampler(seed=1))


def test_point_2_reseeding_reaches_the_independent_sampler() -> None:
    independent = RandomSampler(seed=0)
    before = str(independent._rng.rng.get_state())
    sampler = FIDESampler(seed=0, independent_sampler=independent)
    sampler.reseed_rng()
    assert str(independent._rng.rng.get_state()) != before


ELSEWHERE = """
import json
import optuna
from fide_adapters.optuna import FIDESampler

optuna.logging.set_verbosity(optuna.logging.ERROR)
study = optuna.create_study(sampler=FIDESampler(seed=1))
study.optimize(lambda t: t.suggest_float("a", 0, 1) + t.suggest_int("g", 1, 3), n_trials=15)
print(json.dumps([[t.params for t in study.trials], hash("differs from process to process")]))
"""


def test_point_2_reproducible_in_another_process() -> None:
    run = [sys.executable, "-c", ELSEWHERE]
    environment = {**os.environ, "PYTHONHASHSEED": "12345"}
    done = subprocess.run(run, env=environment, capture_output=True, text=True, check=True)
    params, hashed = json.loads(done.stdout)
    study = optuna.create_study(sampler=FIDESampler(seed=1))
    study.optimize(lambda t: t.suggest_float("a", 0, 1) + t.suggest_int("g", 1, 3), n_trials=15)
    assert [t.params for t in study.trials] == params
    assert hash("differs from process to process") != hashed


@pytest.mark.parametrize("how", ["pickle", "deepcopy"])
def test_point_3_a_copy_goes_on_as_if_nothing_had_happened(bench: Bench, how: str) -> None:
    study = optuna.create_study(sampler=bench.sampler(patience=2))
    bench.run(study, 30)
    sampler = study.sampler
    copied = pickle.loads(pickle.dumps(sampler)) if how == "pickle" else copy.deepcopy(sampler)
    again = copy.deepcopy(study)
    again.sampler = copied
    bench.run(study, 30)
    bench.run(again, 30)
    np.testing.assert_array_equal(bench.points(again), bench.points(study))
    assert counts_of(study)["image"] == 60


def test_point_3_a_pickle_holds_no_image_and_no_lock(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, 100)
    small = len(pickle.dumps(study.sampler))
    bench.run(study, 100)
    assert len(pickle.dumps(study.sampler)) < 1.2 * small


# -- point 9: trials that the sampler did not make -------------------------------------------------


def test_point_9_enqueued_whole_and_in_part(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler(search_space=bench.space))
    answer = dict(zip(bench.names, bench.answer.tolist(), strict=True))
    study.enqueue_trial(answer)
    study.enqueue_trial({"x0": 0.7})
    bench.run(study, 30)
    assert study.trials[0].params == answer and study.trials[1].params["x0"] == 0.7
    assert counts_of(study) == {"guest": 1, "foreign": 1, "member": 28, "image": 30}
    # what was enqueued is learned from: the search goes on around it
    near = np.abs(bench.points(study)[-6:] - bench.answer).max()
    assert near < np.abs(asked_by_core(bench, 30)[-6:] - bench.answer).max()


def test_point_9_trials_are_added_before_during_and_after(bench: Bench) -> None:
    def add(study: optuna.Study) -> None:
        study.add_trial(
            optuna.create_trial(
                params=dict.fromkeys(bench.names, 0.5), distributions=bench.space, value=0.5
            )
        )

    study = optuna.create_study(sampler=bench.sampler())
    add(study)
    bench.run(study, 10)
    add(study)
    bench.run(study, 10)
    add(study)
    assert counts_of(study) == {"guest": 3, "member": 20, "image": 20}


def test_point_9_a_copied_study_goes_on(bench: Bench) -> None:
    first, second = optuna.storages.InMemoryStorage(), optuna.storages.InMemoryStorage()
    study = optuna.create_study(study_name="a", storage=first, sampler=bench.sampler())
    bench.run(study, 30)
    optuna.copy_study(from_study_name="a", from_storage=first, to_storage=second)
    copied = optuna.load_study(study_name="a", storage=second, sampler=bench.sampler())
    bench.run(copied, 20)
    assert counts_of(copied)["image"] == 50  # the features came along
    assert counts_of(copied)["member"] + counts_of(copied)["foreign"] == 50


def test_point_9_a_study_that_another_sampler_began(bench: Bench) -> None:
    study = optuna.create_study(sampler=RandomSampler(seed=0))
    study.optimize(lambda t: float(np.sum(bench.suggest(t))), n_trials=20)
    study.sampler = bench.sampler()
    bench.run(study, 10)
    assert counts_of(study) == {"guest": 20, "member": 10, "image": 10}


def test_point_9_told_by_number_and_asked_with_distributions(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    for _ in range(20):
        trial = study.ask(fixed_distributions=bench.space)
        x = [trial.params[name] for name in bench.names]
        study.tell(trial.number, bench.sampler_of(study).tell_image(trial, bench.render(x)))
    assert counts_of(study) == {"member": 20, "image": 20}


@pytest.mark.parametrize("startup", [0, 5])
def test_point_9_startup_trials_are_drawn_independently(bench: Bench, startup: int) -> None:
    study = optuna.create_study(
        sampler=bench.sampler(search_space=bench.space, n_startup_trials=startup)
    )
    bench.run(study, 20)
    assert counts_of(study).get("guest", 0) == startup


# -- point 10: results that are none ---------------------------------------------------------------


@pytest.mark.parametrize("bad", ["fail", "pruned", "nan", "inf", "-inf", "huge", "constant"])
def test_point_10_any_result_is_survived(bench: Bench, bad: str) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    sampler = study.sampler
    assert isinstance(sampler, FIDESampler)

    def objective(trial: Trial) -> float:
        value = sampler.tell_image(trial, bench.render(bench.suggest(trial)))
        if bad == "constant":
            return 0.25
        if trial.number % 3:
            return value
        if bad == "fail":
            raise ValueError("the renderer crashed")
        if bad == "pruned":
            trial.report(value, 1)
            raise optuna.TrialPruned
        return {"huge": 1e308}.get(bad, float(bad.replace("huge", "nan")))

    study.optimize(objective, n_trials=60, catch=ValueError)
    study.optimize(bench.objective(sampler), n_trials=50)
    X = bench.points(study)
    assert np.isfinite(X).all() and X.min() >= 0 and X.max() <= 1
    failed = sum(t.state is not TrialState.COMPLETE for t in study.trials)
    counts = counts_of(study)
    assert counts.get("left out", 0) == failed == (20 if bad in ("fail", "pruned", "nan") else 0)
    assert counts["member"] + counts.get("guest", 0) == 110 - failed
    assert sampler._memory is not None and not sampler._memory.tokens


def test_point_10_the_features_of_a_failed_trial_are_released(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    sampler = study.sampler
    assert isinstance(sampler, FIDESampler)
    trial = study.ask()
    sampler.tell_image(trial, bench.render(bench.suggest(trial)))
    assert sampler._memory is not None and len(sampler._memory.tokens) == 1
    study.tell(trial, state=TrialState.FAIL)
    assert not sampler._memory.tokens


def test_point_10_pruned_trials_count_where_asked_for(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler(consider_pruned_trials=True))
    sampler = study.sampler
    assert isinstance(sampler, FIDESampler)

    def objective(trial: Trial) -> float:
        value = sampler.tell_image(trial, bench.render(bench.suggest(trial)))
        trial.report(value, 0)
        if trial.number in (3, 4):
            raise optuna.TrialPruned
        return value

    study.optimize(objective, n_trials=20)
    assert counts_of(study) == {"member": 20, "image": 20}


# -- point 11: spaces ------------------------------------------------------------------------------


def test_point_11_conditional_parameters(bench: Bench) -> None:
    study = optuna.create_study(sampler=FIDESampler(seed=0))

    def objective(trial: Trial) -> float:
        kind = trial.suggest_categorical("kind", ["a", "b"])
        x = trial.suggest_float("x", -5, 5)
        if kind == "a":
            return x * x + trial.suggest_float("only a", 0, 1)
        return x * x + trial.suggest_int("only b", 1, 3)

    study.optimize(objective, n_trials=100)
    assert all(t.state is TrialState.COMPLETE for t in study.trials)
    assert study.best_value < 0.3


def test_point_11_a_space_that_changes_and_changes_back(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    sampler = study.sampler
    assert isinstance(sampler, FIDESampler)

    def other(trial: Trial) -> float:
        trial.suggest_float("x0", 0.0, 2.0)
        return trial.suggest_float("new", 0, 1)

    with caplog.at_level(logging.WARNING, "fide_adapters.optuna"):
        bench.run(study, 20)
        study.optimize(other, n_trials=20)
        bench.run(study, 20)
    assert [r.message.split(";")[0] for r in caplog.records] == [
        "the search space of the study has changed"
    ]
    counts = counts_of(study)
    assert counts["left out"] == 20
    assert counts["member"] == 20 + 10 and counts["guest"] == 10  # searched together again
    assert sorted(study.trials[35].params) == ["new", "x0"]
    spaces = sampler.infer_relative_search_space(study, study.trials[-1])
    assert list(spaces) == list(bench.names)


def test_point_11_a_range_that_never_stays_is_left_to_the_independent_sampler() -> None:
    study = optuna.create_study(sampler=FIDESampler(seed=0))

    def objective(trial: Trial) -> float:
        x = trial.suggest_float("x", 0, 1)
        return x + trial.suggest_float("y", 0, x + 0.1)

    study.optimize(objective, n_trials=40)
    trial = study.trials[-1]
    assert list(study.sampler.infer_relative_search_space(study, trial)) == ["x"]
    assert counts_of(study)["member"] > 30
    assert study.best_value < 0.1


# -- points 12 and 13: directions, constraints -----------------------------------------------------


def test_point_12_maximizing_is_minimizing_the_opposite(bench: Bench) -> None:
    runs = []
    directions: Any = ("minimize", "maximize")
    for direction, sign in zip(directions, (1.0, -1.0), strict=True):
        sampler = bench.sampler()
        study = optuna.create_study(direction=direction, sampler=sampler)

        def objective(trial: Trial, sampler: FIDESampler = sampler, sign: float = sign) -> float:
            image = bench.render(bench.suggest(trial))
            loss = float(np.square(image - bench.target).mean())
            return sampler.tell_image(trial, image, sign * loss)

        study.optimize(objective, n_trials=50)
        runs.append(bench.points(study))
    np.testing.assert_array_equal(runs[0], runs[1])


def test_point_12_the_sampler_s_own_loss_is_not_to_be_maximized(bench: Bench) -> None:
    study = optuna.create_study(direction="maximize", sampler=bench.sampler())
    trial = study.ask()
    image = bench.render(bench.suggest(trial))
    with pytest.raises(ProtocolError, match="maximizes; give a loss"):
        bench.sampler_of(study).tell_image(trial, image)
    assert not study.trials[0].system_attrs.keys() & {"fide:image"}


def test_point_13_several_objectives_are_refused_by_name(bench: Bench) -> None:
    study = optuna.create_study(directions=["minimize", "minimize"], sampler=bench.sampler())
    trial = study.ask()
    with pytest.raises(ValueError, match="FIDESampler cannot be used"):
        study.sampler.sample_independent(study, study.trials[0], "x", FloatDistribution(0, 1))
    with pytest.raises(ValueError, match="FIDESampler cannot be used"):
        study.sampler.sample_relative(study, study.trials[0], bench.space)
    with pytest.raises(ValueError, match="FIDESampler cannot be used"):
        trial.suggest_float("x", 0, 1)


def test_point_13_constraints_are_used(bench: Bench) -> None:
    """The answer is forbidden: what is found violates nothing, and is the best of that."""
    study = optuna.create_study(sampler=bench.sampler())
    sampler = study.sampler
    assert isinstance(sampler, FIDESampler)

    def objective(trial: Trial) -> float:
        x = bench.suggest(trial)
        trial.set_constraint("left half", x[0] - 0.5)
        return sampler.tell_image(trial, bench.render(x))

    study.optimize(objective, n_trials=200)
    assert study.best_trial.params["x0"] <= 0.5
    last = [t for t in study.trials[-60:]]
    assert sum(t.params["x0"] <= 0.5 for t in last) > 30
    assert study.best_trial.params["x0"] > 0.42


# -- point 14: in other hands ----------------------------------------------------------------------


def test_point_14_under_hyperband(bench: Bench) -> None:
    study = optuna.create_study(
        sampler=bench.sampler(),
        pruner=optuna.pruners.HyperbandPruner(min_resource=1, max_resource=4),
    )
    sampler = study.sampler
    assert isinstance(sampler, FIDESampler)

    def objective(trial: Trial) -> float:
        value = sampler.tell_image(trial, bench.render(bench.suggest(trial)))
        for step in range(4):
            trial.report(value + 0.1 / (step + 1), step)
            if trial.should_prune():
                raise optuna.TrialPruned
        return value

    study.optimize(objective, n_trials=60)
    complete = len(study.get_trials(states=(TrialState.COMPLETE,)))
    counts = counts_of(study)
    assert counts["left out"] == 60 - complete
    assert counts["member"] == complete == counts["image"]


def test_point_14_inside_partial_fixed(bench: Bench) -> None:
    sampler = bench.sampler()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        fixed = PartialFixedSampler({"x1": 0.35}, sampler)
    study = optuna.create_study(sampler=fixed)
    study.optimize(image_objective(lambda trial: bench.render(bench.suggest(trial))), n_trials=30)
    assert all(t.params["x1"] == 0.35 for t in study.trials)
    counts = sampler.counts(study)
    assert counts == {"guest": 1, "member": 29, "image": 30}


def test_point_14_the_independent_sampler_is_told(bench: Bench) -> None:
    calls: list[str] = []

    class Independent(RandomSampler):
        def before_trial(self, study: Any, trial: Any) -> None:
            calls.append("before")

        def after_trial(self, study: Any, trial: Any, state: Any, values: Any) -> None:
            calls.append("after")

        def reseed_rng(self) -> None:
            calls.append("reseed")

    sampler = bench.sampler(independent_sampler=Independent())
    study = optuna.create_study(sampler=sampler)
    bench.run(study, 2)
    sampler.reseed_rng()
    assert calls == ["before", "after", "before", "after", "reseed"]


# -- points 17 and 18: images ----------------------------------------------------------------------


def as_png(image: Any) -> Any:
    return Image.fromarray(np.round(image * 255).astype(np.uint8))


GOOD: dict[str, Any] = {
    "HxWx3": lambda image: image,
    "HxWx1": lambda image: image[..., :1],
    "HxW": lambda image: image[..., 0],
    "HxWx4": lambda image: np.dstack([image, np.ones(image.shape[:2])]),
    "CHW tensor": lambda image: torch.from_numpy(image).permute(2, 0, 1),
    "uint8": lambda image: np.round(image * 255).astype(np.uint8),
    "bool": lambda image: image > 0.5,
    "float64": lambda image: image.astype(np.float64),
    "not contiguous": lambda image: np.repeat(image, 2, axis=0)[::2],
    "PIL": as_png,
}


@pytest.mark.parametrize("form", GOOD)
def test_point_17_forms_of_images(bench: Bench, form: str) -> None:
    sampler = bench.sampler()
    study = optuna.create_study(sampler=sampler)
    image = GOOD[form](bench.render(bench.answer))
    study.optimize(
        lambda trial: sampler.tell_image(trial, image) + 0 * sum(bench.suggest(trial)), n_trials=1
    )
    assert counts_of(study) == {} or counts_of(study)["image"] == 1
    assert "fide:image" in study.trials[0].system_attrs
    if form in ("HxWx3", "CHW tensor", "float64", "not contiguous", "HxWx4"):
        assert study.trials[0].value == pytest.approx(0.0, abs=1e-12)


BAD: dict[str, tuple[Any, str]] = {
    "NaN": (np.full((8, 8, 3), np.nan), "finite"),
    "another size": (np.zeros((9, 8, 3)), r"\(9, 8, 3\)"),
    "1x1": (np.zeros((1, 1, 3)), r"\(1, 1, 3\)"),
    "two channels": (np.zeros((8, 8, 2)), r"\(8, 8, 2\)"),
    "int64": (np.zeros((8, 8, 3), np.int64), "int64"),
    "text": ("/no/such/file.png", "/no/such/file.png"),
    "a batch": (np.zeros((2, 8, 8, 3)), r"\(2, 8, 8, 3\)"),
}


@pytest.mark.parametrize("what", BAD)
def test_point_17_bad_images_change_nothing(bench: Bench, what: str) -> None:
    image, message = BAD[what]
    sampler = bench.sampler()
    study = optuna.create_study(sampler=sampler)
    trial = study.ask()
    with pytest.raises(ImageError, match=f"(?s){message}") as caught:
        sampler.tell_image(trial, image)
    assert isinstance(caught.value, ValueError)
    assert not study.trials[0].system_attrs
    assert sampler._memory is None or not sampler._memory.tokens


def test_point_17_bad_losses_and_features_change_nothing(bench: Bench) -> None:
    sampler = bench.sampler()
    study = optuna.create_study(sampler=sampler)
    trial = study.ask()
    image = bench.render(bench.answer)
    tokens = encoders.make("dense")(image[None])
    bad_losses: list[Any] = ["low", None, 1j, [0.0, 1.0]]
    for loss in bad_losses[:1] + bad_losses[2:]:
        with pytest.raises(LossError):
            sampler.tell_image(trial, image, loss)
    for loss in bad_losses:
        with pytest.raises(LossError):
            sampler.tell_features(trial, tokens, loss)
    for features in (tokens[0, :3], tokens[..., :4], tokens * float("nan"), "text", None):
        with pytest.raises(FeaturesError):
            sampler.tell_features(trial, features, 0.5)
    assert not study.trials[0].system_attrs


def test_features_are_as_good_as_the_image(bench: Bench) -> None:
    encode = encoders.make("dense")
    near: FIDESampler = bench.sampler()
    far: FIDESampler = bench.sampler()
    studies = [optuna.create_study(sampler=sampler) for sampler in (near, far)]
    bench.run(studies[0], 40)

    def objective(trial: Trial) -> float:
        image = bench.render(bench.suggest(trial))
        loss = float(np.square(image.astype(np.float64) - bench.target).mean())
        return far.tell_features(trial, encode(image[None]), loss)

    studies[1].optimize(objective, n_trials=40)
    np.testing.assert_array_equal(bench.points(studies[0]), bench.points(studies[1]))


@pytest.mark.parametrize("kind", ["image", "pair", "image loss", "features", "file"])
def test_image_objectives(bench: Bench, kind: str, tmp_path: Any) -> None:
    encode = encoders.make("dense")

    def render(trial: Trial) -> Any:
        image = bench.render(bench.suggest(trial))
        loss = float(np.square(image.astype(np.float64) - bench.target).mean())
        if kind == "file":
            np.save(tmp_path / "image.npy", image)
            return ImageLoss(loss, ImageRef(tmp_path / "image.npy"))
        if kind == "features":
            return ImageLoss(loss, features=encode(image[None])[0].numpy())
        return {"image": image, "pair": (loss, image), "image loss": ImageLoss(loss, image)}[kind]

    study = optuna.create_study(sampler=bench.sampler())
    study.optimize(image_objective(render), n_trials=20)
    plain = optuna.create_study(sampler=bench.sampler())
    bench.run(plain, 20)
    np.testing.assert_array_equal(bench.points(study), bench.points(plain))


def test_an_image_objective_may_give_no_image(bench: Bench) -> None:
    sampler = bench.sampler()
    study = optuna.create_study(sampler=sampler)
    study.optimize(sampler.image_objective(lambda trial: sum(bench.suggest(trial))), n_trials=5)
    assert counts_of(study)["image"] == 0
    assert all(t.value == pytest.approx(sum(t.params.values())) for t in study.trials)


def test_an_image_objective_needs_a_sampler_of_ours(bench: Bench) -> None:
    study = optuna.create_study(sampler=RandomSampler(seed=0))
    with pytest.raises(ProtocolError, match="name it"):
        study.optimize(image_objective(lambda t: bench.render(bench.suggest(t))), n_trials=1)


def test_an_objective_can_be_called_with_the_best_trial(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, 20)
    objective = bench.objective(study.sampler)
    assert objective(study.best_trial) == study.best_value
    assert objective(FixedTrial(study.best_params)) == study.best_value


def test_point_18_an_image_is_not_kept(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    sampler = study.sampler
    assert isinstance(sampler, FIDESampler)
    images: list[weakref.ref[Any]] = []

    def objective(trial: Trial) -> float:
        image = bench.render(bench.suggest(trial))
        images.append(weakref.ref(image))
        return sampler.tell_image(trial, image)

    study.optimize(objective, n_trials=20)
    gc.collect()
    assert [ref() for ref in images] == [None] * 20


# -- what a user may get wrong ---------------------------------------------------------------------


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
    "loss without target": ({"target": None, "loss": "mse"}, OptionError, "target"),
}


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
        study.add_trial(
            optuna.create_trial(
                params=dict.fromkeys(bench.names, 0.5),
                distributions=bench.space,
                value=0.5,
                system_attrs={key: record},
            )
        )
    if record is None:
        bench.run(study, 5)
    else:
        with pytest.warns(RuntimeWarning, match=key) as caught:
            bench.run(study, 5)
        assert len(caught) == 1
    assert counts_of(study) == {"guest": 3, "member": 5, "image": 5}


def test_records_that_name_trials_that_cannot_be_meant(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    ask = {"v": 1, "m": "x", "g": 0, "i": 0, "passed": [0, 99], "late": [1, 5, 2**40]}
    study.add_trial(
        optuna.create_trial(
            params=dict.fromkeys(bench.names, 0.5),
            distributions=bench.space,
            value=0.5,
            system_attrs={"fide:ask": ask},
        )
    )
    bench.run(study, 10)
    assert counts_of(study) == {"guest": 1, "member": 10, "image": 10}


def test_it_is_found_where_the_optimizer_is() -> None:
    import fide_plugins

    assert fide_plugins.FIDESampler is FIDESampler
