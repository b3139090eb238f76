"""What objectives may give, and which trials an image is recorded in (acceptance point 17)."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.samplers import RandomSampler
from optuna.trial import FixedTrial, Trial
from PIL import Image

from fide_adapters.optuna import ImageLoss, image_objective
from fide_plugins.errors import LossError, ProtocolError

from .conftest import Bench, counts_of


@pytest.mark.parametrize("loss", ["low", 1j, [0.0, 1.0]])
def test_point_17_a_bad_loss_changes_nothing(bench: Bench, loss: Any) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    trial = study.ask()
    with pytest.raises(LossError):
        bench.sampler_of(study).tell_image(trial, bench.target, loss)
    assert not study.trials[0].system_attrs


@pytest.mark.parametrize("kind", ["image", "pair", "image loss", "lists"])
def test_image_objectives(bench: Bench, kind: str) -> None:
    def render(trial: Trial) -> Any:
        image = bench.render(bench.suggest(trial))
        loss = float(np.square(image.astype(np.float64) - bench.target).mean())
        if kind == "lists":
            return image.tolist()
        return {"image": image, "pair": (loss, image), "image loss": ImageLoss(loss, image)}[kind]

    study = optuna.create_study(sampler=bench.sampler())
    study.optimize(image_objective(render), n_trials=20)
    plain = optuna.create_study(sampler=bench.sampler())
    bench.run(plain, 20)
    np.testing.assert_array_equal(bench.points(study), bench.points(plain))


def test_an_image_objective_may_give_a_path(bench: Bench, tmp_path: Path) -> None:
    def render(trial: Trial) -> Any:
        image = np.round(bench.render(bench.suggest(trial)) * 255).astype(np.uint8)
        Image.fromarray(image).save(tmp_path / "image.png")
        return tmp_path / "image.png"

    study = optuna.create_study(sampler=bench.sampler())
    study.optimize(image_objective(render), n_trials=5)
    assert counts_of(study)["image"] == 5


def test_an_image_objective_needs_a_sampler_of_ours(bench: Bench) -> None:
    study = optuna.create_study(sampler=RandomSampler(seed=0))
    with pytest.raises(ProtocolError, match="name it"):
        study.optimize(image_objective(lambda t: bench.render(bench.suggest(t))), n_trials=1)


def test_an_objective_can_be_called_with_the_best_trial(bench: Bench) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    bench.run(study, 20)
    objective = bench.objective(bench.sampler_of(study))
    assert objective(study.best_trial) == study.best_value
    assert objective(FixedTrial(study.best_params)) == study.best_value


@pytest.mark.parametrize(
    ("what", "kind"),
    [
        (lambda t: t.number, "int"),
        (lambda t: SimpleNamespace(number=t.number, trial=t), "SimpleNamespace"),
        (lambda t: None, "NoneType"),
    ],
)
def test_what_is_no_trial_is_refused_with_what_to_give(bench: Bench, what: Any, kind: str) -> None:
    sampler = bench.sampler()
    trial = optuna.create_study(sampler=sampler).ask()
    with pytest.raises(ProtocolError, match=f"not in an object of type {kind}; give that trial"):
        sampler.tell_image(what(trial), bench.target)
