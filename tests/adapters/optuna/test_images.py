"""Which images are taken, and that none is kept (acceptance points 17 and 18)."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.samplers import RandomSampler
from optuna.trial import BaseTrial, FixedTrial, Trial, TrialState
from PIL import Image

from fide_adapters.optuna import ImageLoss, ImageRef, image_objective
from fide_adapters.optuna.storage import IMAGE
from fide_plugins import encoders
from fide_plugins.errors import FeaturesError, LossError, ProtocolError

from .conftest import Bench, counts_of


def as_png(image: Any) -> Any:
    return Image.fromarray(np.round(image * 255).astype(np.uint8))


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


@pytest.mark.parametrize("how", ["tell_features", "image loss"])
def test_features_of_another_version_are_not_stored(bench: Bench, how: str) -> None:
    encoder, sampler = encoders.make("dense"), bench.sampler()
    study = optuna.create_study(sampler=sampler)
    for version in ("dense-0", encoder.version):

        def see(trial: Trial, version: str = version) -> ImageLoss:
            tokens = encoder(bench.render(bench.suggest(trial))[None])[0].numpy()
            return ImageLoss(0.5, features=tokens, version=version)

        def tell(trial: Trial) -> float:
            seen = see(trial)
            return sampler.tell_features(trial, seen.features, 0.5, version=seen.version)

        objective = tell if how == "tell_features" else sampler.image_objective(see)
        study.optimize(objective, n_trials=1, catch=FeaturesError)
    first, second = study.trials
    assert first.state is TrialState.FAIL and IMAGE not in first.system_attrs
    assert second.state is TrialState.COMPLETE and IMAGE in second.system_attrs


@pytest.mark.parametrize("kind", ["image", "pair", "image loss", "features", "file", "lists"])
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
        if kind == "lists":
            return image.tolist()
        return {"image": image, "pair": (loss, image), "image loss": ImageLoss(loss, image)}[kind]

    study = optuna.create_study(sampler=bench.sampler())
    study.optimize(image_objective(render), n_trials=20)
    plain = optuna.create_study(sampler=bench.sampler())
    bench.run(plain, 20)
    np.testing.assert_array_equal(bench.points(study), bench.points(plain))


@pytest.mark.parametrize("pair", [False, True])
def test_an_image_objective_may_give_a_path(bench: Bench, pair: bool, tmp_path: Path) -> None:
    def render(trial: Trial) -> Any:
        as_png(bench.render(bench.suggest(trial))).save(tmp_path / "image.png")
        return (0.5, str(tmp_path / "image.png")) if pair else tmp_path / "image.png"

    study = optuna.create_study(sampler=bench.sampler())
    study.optimize(image_objective(render), n_trials=5)
    assert counts_of(study)["image"] == 5
    for trial in study.trials if not pair else ():
        x = np.array(list(trial.params.values()))
        image = np.asarray(as_png(bench.render(x)), np.float64) / 255
        assert trial.value == pytest.approx(np.square(image - bench.target).mean(), rel=1e-4)


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
    image = bench.render(bench.suggest(trial))
    tokens = encoders.make("dense")(image[None])
    with pytest.raises(ProtocolError, match=f"not in an object of type {kind}; give that trial"):
        sampler.tell_image(what(trial), image)
    with pytest.raises(ProtocolError, match=f"not in an object of type {kind}; give that trial"):
        sampler.tell_features(what(trial), tokens, 0.5)


@pytest.mark.parametrize(
    ("pair", "what"), [(False, "an image, a"), (True, r"a pair \(loss, image\), the image a")]
)
def test_an_objective_that_returns_a_bare_image_is_told_what_to_do(
    bench: Bench, pair: bool, what: str
) -> None:
    def objective(trial: BaseTrial) -> Any:
        image = bench.render(bench.suggest(trial))
        return (0.5, image) if pair else image

    study = optuna.create_study(sampler=bench.sampler())
    wrapped = r"study.optimize\(image_objective\(objective\)\)"
    with pytest.warns(RuntimeWarning, match=rf"{what} ndarray of shape \(8, 8, 3\).*{wrapped}"):
        study.optimize(objective, n_trials=1)
    bench.run(study, 2)
    other = optuna.create_study(sampler=study.sampler)
    other.optimize(image_objective(objective), n_trials=2)
    assert [trial.state.name for trial in study.trials] == ["FAIL", "COMPLETE", "COMPLETE"]
    assert [trial.state.name for trial in other.trials] == ["COMPLETE"] * 2


@pytest.mark.parametrize("value", [None, "abc", Path("a.png"), (0.5, "abc"), [[1, 2], [3, 4]]])
def test_an_objective_that_returns_something_else_is_left_to_optuna(
    bench: Bench, value: Any
) -> None:
    study = optuna.create_study(sampler=bench.sampler())
    study.optimize(lambda trial: value if bench.suggest(trial) else 0.0, n_trials=2)
    bench.run(study, 1)
    assert [trial.state.name for trial in study.trials] == ["FAIL", "FAIL", "COMPLETE"]


def test_an_objective_that_raises_is_no_such_mistake(bench: Bench) -> None:
    def raises(trial: BaseTrial) -> float:
        raise ValueError(bench.suggest(trial))

    study = optuna.create_study(sampler=bench.sampler())
    study.optimize(raises, n_trials=2, catch=ValueError)
    assert len(study.trials) == 2
