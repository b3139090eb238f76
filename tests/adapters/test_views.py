"""Views and masks are the same in the core, in Nevergrad, in Optuna and in replicas."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import nevergrad as ng
import numpy as np
import optuna
import pytest
from optuna.artifacts import FileSystemArtifactStore

from fide_adapters.image_loss import is_image
from fide_adapters.nevergrad import ParametrizedFIDE
from fide_adapters.optuna import FIDESampler
from fide_plugins import FIDE
from fide_plugins.distributed.replica import Replica
from fide_plugins.errors import ImageError
from fide_plugins.types import Float32, Float64

DIM = 4
MASK = np.ones((10, 14), np.float32)
MASK[:, :4] = 0


def views(x: Any) -> list[Float32]:
    """A soft disk at x[0:2] of brightness x[2], and its profile of brightness x[3]."""
    rows, columns = (np.arange(12) + 0.5) / 12, (np.arange(14) + 0.5) / 14
    front = np.exp(-20 * ((rows[:, None] - x[0]) ** 2 + (rows - x[1]) ** 2)) * x[2]
    side = np.exp(-20 * np.square(columns - x[0]))[None].repeat(10, 0) * x[3]
    return [np.dstack([image] * 3).astype(np.float32) for image in (front, side)]


TARGETS = views([0.7, 0.4, 0.9, 0.6])
SETTINGS: dict[str, Any] = {"mask": [None, MASK], "seed": 0, "popsize": 6}


def core() -> FIDE:
    return FIDE(DIM, TARGETS, **SETTINGS)


def told(opt: FIDE, X: Float64) -> None:
    fronts, sides = zip(*(views(x) for x in X), strict=True)
    opt.tell(X, [np.stack(fronts), np.stack(sides)])


def test_a_single_mask_is_that_of_all_views_of_its_size() -> None:
    targets = [TARGETS[1], 1 - TARGETS[1]]
    box = ng.p.Array(shape=(DIM,), lower=0, upper=1)
    made: list[tuple[Any, Any]] = []
    for mask in (MASK, [MASK, MASK]):
        optimizer: Any = ParametrizedFIDE(target=targets, mask=mask, seed=0)(box)
        optimizer.ask()
        sampler = FIDESampler(targets, mask=mask, seed=0)
        images = sampler._images()
        made.append((optimizer.fide.encoder.version, images.evaluator.encoder.version))
    assert made[0] == made[1]
    assert made[0] != (FIDE(DIM, targets).encoder.version,) * 2


def test_nevergrad_asks_and_tells_the_same() -> None:
    alone = core()
    box = ng.p.Array(shape=(DIM,), lower=0, upper=1)
    optimizer: Any = ParametrizedFIDE(target=TARGETS, **SETTINGS)(box)
    for number in range(40):
        X, candidate = alone.ask(1), optimizer.ask()
        np.testing.assert_allclose(candidate.value, X[0], rtol=0, atol=1e-9)
        told(alone, X)
        images = views(X[0])
        optimizer.tell(candidate, tuple(images) if number % 2 else images)
        if number == 20:
            optimizer = pickle.loads(pickle.dumps(optimizer))
    assert alone.best is not None and optimizer.num_images == 40
    assert optimizer.recommend().loss == pytest.approx(alone.best.loss, rel=1e-12)


def test_optuna_asks_and_tells_the_same() -> None:
    """As one who asks whole generations: so replicas hand them out."""
    alone = core()
    names = [f"x{i}" for i in range(DIM)]
    space: Any = {name: optuna.distributions.FloatDistribution(0, 1) for name in names}
    sampler = FIDESampler(TARGETS, search_space=space, **SETTINGS)
    study = optuna.create_study(sampler=sampler)
    while alone.evaluations < 40:
        X = alone.ask()
        for x in X:
            trial = study.ask()
            suggested = [trial.suggest_float(name, 0, 1) for name in names]
            np.testing.assert_allclose(suggested, x, rtol=0, atol=1e-15)
            study.tell(trial, sampler.tell_image(trial, views(x)))
        told(alone, X)
    assert alone.best is not None
    assert study.best_value == pytest.approx(alone.best.loss, rel=1e-12)
    assert sampler.counts(study) == {"member": alone.evaluations, "image": alone.evaluations}


@pytest.mark.parametrize(
    ("given", "got"),
    [(np.zeros((20, 24, 3)), "one image, .*"), ([np.zeros((20, 24))] * 3, "3 images")],
)
def test_other_images_than_one_for_each_view_are_refused(given: Any, got: str) -> None:
    optimizer: Any = ParametrizedFIDE(target=TARGETS, **SETTINGS)(ng.p.Array(shape=(DIM,)))
    sampler = FIDESampler(TARGETS, **SETTINGS)
    trial = optuna.create_study(sampler=sampler).ask()
    rule = rf"2 targets a render is a list of 2 images, one for each view, .*; got {got}$"
    with pytest.raises(ImageError, match=rule):
        sampler.tell_image(trial, given)
    with pytest.raises(ImageError, match=rule):
        optimizer.tell(optimizer.ask(), 0.1, image=given)


def test_images_of_views_come_back_from_an_artifact_store(tmp_path: Path) -> None:
    store = FileSystemArtifactStore(str(tmp_path))
    first = FIDESampler(TARGETS, artifact_store=store, **SETTINGS)
    study = optuna.create_study(sampler=first)

    def objective(trial: optuna.Trial) -> float:
        x = [trial.suggest_float(f"x{i}", 0, 1) for i in range(DIM)]
        return first.tell_image(trial, views(x), loss=x[0])

    study.optimize(objective, n_trials=8)
    trial = study.trials[-1]
    stored = first._states.of(study).from_artifact(study, trial)
    assert stored is not None
    tokens = core().encoder([[image] for image in views(list(trial.params.values()))])[0]
    np.testing.assert_allclose(stored, tokens, atol=2 / 255)


def test_replicas_agree() -> None:
    one, other = Replica(core()), Replica(core())
    for number in range(30):
        generation, slot = one.generation, number % 6
        x = one.candidate(slot).x
        images = [image[None] for image in views(x)]
        evaluator = one.optimizer.evaluator
        batch = evaluator.views.as_batch(images, 1, print)
        loss, tokens = float(evaluator.loss.compute(batch)[0]), one.optimizer.encoder(images)[0]
        for replica in (one, other):
            replica.tell(x, loss, tokens, generation=generation, slot=slot)
    np.testing.assert_array_equal(one.candidate(0).x, other.candidate(0).x)
    again = Replica.from_state(core(), pickle.loads(pickle.dumps(one.state_dict())))
    np.testing.assert_array_equal(one.candidate(3).x, again.candidate(3).x)


def test_targets_and_masks_are_settings() -> None:
    same = ParametrizedFIDE(target=TARGETS, mask=[None, MASK])
    assert same == ParametrizedFIDE(target=TARGETS, mask=[None, MASK])
    assert same != ParametrizedFIDE(target=TARGETS)
    optimizer: Any = ParametrizedFIDE()(ng.p.Array(shape=(DIM,), lower=0, upper=1))
    optimizer.target = TARGETS
    assert len(optimizer.target) == 2


@pytest.mark.parametrize("make", [FIDESampler, ParametrizedFIDE])
def test_a_mask_belongs_to_a_target(make: Any) -> None:
    with pytest.raises(ImageError, match="mask, weights and value_range belong to a target"):
        make(mask=MASK)


def test_a_list_of_images_is_an_image_and_a_list_of_losses_is_none() -> None:
    assert is_image(TARGETS) and is_image(tuple(TARGETS))
    assert not is_image([0.1, 0.2]) and not is_image([]) and not is_image((0.1, TARGETS[0]))
