"""A range of values in Nevergrad and Optuna: the losses of the same images scaled by hand."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fide_plugins.errors import ImageError, ValueRangeError

V, U = np.mgrid[0:16, 0:16] / 15


def draw(x: float, y: float) -> Any:
    return np.exp(-((U - x) ** 2 + (V - y) ** 2) / 0.08).astype(np.float32)


TARGET = draw(0.6, 0.4)


def test_nevergrad(tmp_path: Path) -> None:
    ng = pytest.importorskip("nevergrad")
    from fide_adapters.image_loss import ImageRef
    from fide_adapters.nevergrad import ParametrizedFIDE

    def made(target: Any, **options: Any) -> Any:
        box = ng.p.Array(shape=(2,), lower=0, upper=1)
        return ParametrizedFIDE(target=target, seed=0, **options)(box, budget=40)

    given, plain = made(10 * TARGET - 3, value_range=(-3, 17)), made(TARGET / 2)
    for _ in range(6):
        one, other = given.ask(), plain.ask()
        np.testing.assert_array_equal(one.value, other.value)
        image = draw(*one.value)
        given.tell(one, 10 * image - 3)
        plain.tell(other, image / 2)
        assert one.loss == pytest.approx(other.loss, rel=1e-4, abs=1e-12)
    np.testing.assert_allclose(given.target[..., 0], 10 * TARGET - 3, atol=1e-5)
    again = pickle.loads(pickle.dumps(given))
    np.testing.assert_array_equal(again.ask().value, given.ask().value)
    given = made(10 * TARGET - 3, value_range="auto")
    candidate = given.ask()
    Image.fromarray(10 * TARGET - 3).save(tmp_path / "a.tif")
    given.tell(candidate, ImageRef(tmp_path / "a.tif"))
    assert candidate.loss < 1e-12
    with pytest.raises(ValueRangeError, match="another scale"):
        given.tell(given.ask(), 1000 * TARGET + 100)
    one, other = (ParametrizedFIDE(target=TARGET, value_range=(0, high)) for high in (2, 4))
    assert one != other
    with pytest.raises(ImageError, match="value_range belong to a target"):
        made(None, value_range=(0, 2))


def test_optuna() -> None:
    optuna = pytest.importorskip("optuna")
    from fide_adapters.optuna import FIDESampler

    optuna.logging.set_verbosity(optuna.logging.ERROR)

    def losses(target: Any, scale: float, shift: float, **options: Any) -> list[float]:
        sampler = FIDESampler(target=target, seed=0, popsize=4, **options)
        study = optuna.create_study(sampler=sampler)

        def objective(trial: Any) -> float:
            x, y = (trial.suggest_float(name, 0, 1) for name in "xy")
            return sampler.tell_image(trial, scale * draw(x, y) + shift)

        study.optimize(objective, n_trials=9)
        return [trial.value for trial in study.trials]

    given = losses(10 * TARGET - 3, 10, -3, value_range=(-3, 17))
    assert given == pytest.approx(losses(TARGET / 2, 0.5, 0), rel=1e-3)
    with pytest.raises(ImageError, match="value_range belong to a target"):
        FIDESampler(value_range="auto")
    with pytest.raises(ValueRangeError, match="another scale"):
        losses(TARGET, 250.5, 0)


def test_images_in_an_artifact_store_are_scaled_already(tmp_path: Path) -> None:
    optuna = pytest.importorskip("optuna")
    from fide_adapters.optuna import FIDESampler

    store = optuna.artifacts.FileSystemArtifactStore(tmp_path)
    optuna.logging.set_verbosity(optuna.logging.ERROR)

    def sampler() -> Any:
        values = {"value_range": (0, 10), "artifact_store": store}
        return FIDESampler(target=10 * TARGET, seed=0, popsize=4, **values)

    first = sampler()
    study = optuna.create_study(sampler=first)
    study.optimize(lambda t: first.tell_image(t, 10 * draw(t.suggest_float("x", 0, 1), 0.4)), 5)
    images = first._settings.images
    for trial in study.trials:
        stored = first._states.of(study).from_artifact(study, trial)
        own = images.tokens(images.read(10 * draw(trial.params["x"], 0.4)))
        np.testing.assert_allclose(stored, own, atol=0.05)
