"""A learned renderer of sets, and parameters found through it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from fide_plugins.errors import OptionError
from fide_plugins.learning import LearnProgress, Model, emulator as inversion, learn
from fide_plugins.learning.emulator import Emulator, inverted
from fide_plugins.learning.networks import as_input
from fide_plugins.learning.posterior import posterior_of
from fide_plugins.learning.renders import Pixels
from fide_plugins.learning.training import Training
from fide_plugins.types import Float64

SIDE, SIZE = 16, (16, 16)
BLOCKS = ((0, 1, 2), (3, 4, 5))
_GRID = (np.arange(SIDE) + 0.5) / SIDE


def lights(x: Float64) -> Float64:
    """Two soft spots of light (x, y, brightness)."""
    image = np.zeros(SIZE)
    for column, row, brightness in x.reshape(2, 3):
        squares = (_GRID[None] - column) ** 2 + (_GRID[:, None] - row) ** 2
        image += (0.1 + 0.4 * brightness) * np.exp(-squares / 0.15)
    return image


def pixels(X: Float64) -> Pixels:
    images = np.stack([lights(x) for x in X])
    return np.repeat(np.rint(255 * images)[..., None], 3, axis=3).astype(np.uint8)


def tell_apart(emulator: Emulator) -> Emulator:
    """Larger weights: images of an emulator that was not trained hardly depend on parameters."""
    with torch.no_grad():
        for weight in emulator.parameters():
            weight.mul_(2)
    return emulator


EVERYWHERE = torch.arange(SIDE * SIDE)


@pytest.fixture(scope="module")
def trained() -> tuple[Emulator, float]:
    """Emulator of the lights, and the share of variance that it does not explain."""
    X = np.random.default_rng(0).random((2000, 6))
    emulator = Emulator(SIZE, [False] * 6, BLOCKS)
    training = Training(emulator, X, pixels(X), 8, augment="none", learning_rate=4e-3, batch=16)
    training.run()
    emulator.zero_grad(set_to_none=True)
    return emulator, training.best


@torch.no_grad()
def test_no_order_of_blocks_counts() -> None:
    emulator = tell_apart(Emulator(SIZE, [False] * 7, BLOCKS))
    u = torch.rand(5, 7, generator=torch.Generator().manual_seed(0))
    swapped, other = u[:, [3, 4, 5, 0, 1, 2, 6]], u[:, [0, 4, 2, 3, 1, 5, 6]]
    colors = emulator(u, EVERYWHERE)
    torch.testing.assert_close(emulator(swapped, EVERYWHERE), colors)
    assert (emulator(other, EVERYWHERE) - colors).abs().amax(dim=(1, 2)).min() > 1e-4


@torch.no_grad()
def test_both_ends_of_a_circle_are_one() -> None:
    emulator = Emulator(SIZE, [True, False, False] * 2 + [True], BLOCKS)
    u = torch.full((2, 7), 0.4)
    u[0, [0, 6]], u[1, [0, 6]] = 0.0, 1.0
    first, second = emulator(u, EVERYWHERE)
    torch.testing.assert_close(first, second, atol=1e-5, rtol=0)


@torch.no_grad()
def test_the_loss_is_the_share_of_variance_that_is_left() -> None:
    """1 for the mean image, at random places on average and at all of them exactly."""
    X = np.random.default_rng(1).random((200, 6))
    images, u = as_input(pixels(X)), torch.from_numpy(X).float()
    emulator = Emulator(SIZE, [False] * 6, BLOCKS)
    emulator.standardize(images)
    for weight in list(emulator.color.parameters())[-2:]:  # of the last layer
        weight.zero_()
    whole = emulator.errors(images, u, EVERYWHERE).mean() / emulator.variance
    assert float(whole) == pytest.approx(1, abs=1e-4)
    generator = torch.Generator().manual_seed(0)
    parts = [float(emulator.loss(images, u, generator)) for _ in range(50)]
    assert np.mean(parts) == pytest.approx(1, abs=4 * np.std(parts) / np.sqrt(50))


@pytest.mark.thorough
def test_it_learns_renders_that_it_has_not_seen(trained: tuple[Emulator, float]) -> None:
    assert trained[1] < 0.1  # other seeds: 0.006 to 0.02


@pytest.mark.thorough
def test_descents_find_what_the_emulator_made(trained: tuple[Emulator, float]) -> None:
    """An identity, whatever was learned: the pictures are the emulator's own.

    One in sixteen of them has no descent that comes so near.
    """
    emulator, least = trained[0], []
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        truth = 0.1 + 0.8 * torch.rand(1, 6, generator=generator)
        with torch.no_grad():
            picture = emulator(truth, EVERYWHERE).transpose(1, 2).reshape(1, 3, *SIZE)
            found = inverted(emulator, picture, torch.rand(32, 6, generator=generator), generator)
            errors = emulator.errors(picture, found, EVERYWHERE)
        assert len(found) == 8
        assert (errors.diff() >= 0).all()  # the best first
        least.append(float(errors[0] / emulator.variance))
    assert np.median(least) < 1e-3
    assert all(weight.grad is None for weight in emulator.parameters())


# -- in a model ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model(trained: tuple[Emulator, float], tmp_path_factory: pytest.TempPathFactory) -> Model:
    """Model whose density has learned next to nothing, with the emulator."""
    path = tmp_path_factory.mktemp("lights") / "model.fide"
    little = learn(lights, 6, renders=100, size=SIDE, passes=1, groups=BLOCKS, emulator=False)
    report = replace(little.report, emulated=1 - trained[1])
    replace(little, emulator=trained[0], report=report).save(path)
    return Model.load(path)


@pytest.mark.thorough
def test_hypotheses_are_what_descents_find(model: Model) -> None:
    """Their renders are nearer to the picture than all but a few of a thousand others."""
    assert model.emulates
    others = np.stack([lights(x) for x in np.random.default_rng(3).random((1000, 6))])
    for seed, truth in enumerate(np.random.default_rng(2).random((2, 6))):
        picture = lights(truth)
        posterior = posterior_of(model, 6, picture, seed)
        assert posterior is not None
        assert posterior.refined is not None
        assert posterior.x.shape == (512, 6)
        assert posterior.refined.shape == (8, 6)
        error = np.square(lights(posterior.refined[0]) - picture).mean()
        assert (np.square(others - picture).mean(axis=(1, 2)) < error).mean() < 0.02


@pytest.fixture
def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Descents that find nothing, where it is their identity that counts."""
    stages = tuple(replace(stage, steps=6) for stage in inversion._STAGES)
    monkeypatch.setattr(inversion, "_STAGES", stages)


@pytest.mark.thorough
@pytest.mark.usefixtures("few_steps")
def test_same_seed_same_hypotheses(model: Model) -> None:
    picture, X = lights(np.full(6, 0.3)), np.random.default_rng(0).random((3, 6))
    first, second, third = (model.refined(picture, X, seed) for seed in (0, 0, 1))
    assert first.shape == (3, 6)
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, third)


@pytest.mark.thorough
def test_without_an_emulator_nothing_is_refined(model: Model) -> None:
    without = replace(model, emulator=None)
    assert not without.emulates
    with pytest.raises(OptionError, match="has no emulator: learn it with emulator=True"):
        without.refined(lights(np.full(6, 0.3)), np.full((1, 6), 0.5))


@pytest.mark.thorough
@pytest.mark.usefixtures("few_steps")
@pytest.mark.parametrize("loaded", ["outside", "inside"])
def test_a_mode_of_the_caller_changes_nothing(model: Model, loaded: str, tmp_path: Path) -> None:
    """Neither that of inference, which forbids gradients, nor that of low precision."""
    picture, X = lights(np.full(6, 0.3)), np.full((1, 6), 0.5)
    expected = model.refined(picture, X)
    model.save(tmp_path / "m.fide")
    with torch.inference_mode():
        one = Model.load(tmp_path / "m.fide") if loaded == "inside" else model
        np.testing.assert_array_equal(one.refined(picture, X), expected)
    np.testing.assert_array_equal(one.refined(picture, X), expected)
    with torch.autocast("cpu", torch.bfloat16):
        np.testing.assert_array_equal(one.refined(picture, X), expected)


def test_where_it_is_learned() -> None:
    """Where blocks are exchangeable, unless somebody wants none."""
    words = {"renders": 100, "size": SIDE, "passes": 1}
    assert learn(lights, 6, **words).emulator is None  # type: ignore[arg-type]
    made = learn(lights, 6, groups=BLOCKS, **words)  # type: ignore[arg-type]
    assert made.emulator is not None
    assert "the emulator explains" in str(made.report)


def test_an_emulator_that_diverged_is_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """And the model is read back: a share that is no number was saved, and refused."""
    test = Training.test

    def diverged(training: Training) -> float:
        return np.nan if isinstance(training.network, Emulator) else test(training)

    monkeypatch.setattr(Training, "test", diverged)
    words = {"renders": 100, "size": SIDE, "passes": 1, "groups": BLOCKS, "out": tmp_path / "m"}
    with pytest.warns(RuntimeWarning, match="the training of the emulator has diverged"):
        model = learn(lights, 6, **words)  # type: ignore[arg-type]
    for one in (model, Model.load(tmp_path / "m")):
        assert one.emulator is None and one.report.emulated is None


class Stop(Exception):
    """Raised while the emulator is learned."""


def test_an_interrupted_training_goes_on_bit_for_bit(tmp_path: Path) -> None:
    seen: list[str] = []

    def stop(at: LearnProgress) -> None:
        seen.append(at.stage)
        if seen.count("emulate") == 1:
            raise Stop

    words = {"renders": 200, "size": SIDE, "passes": 2, "groups": BLOCKS}
    whole = learn(lights, 6, **words)  # type: ignore[arg-type]
    with pytest.raises(Stop):
        learn(lights, 6, out=tmp_path / "m.fide", on_progress=stop, **words)  # type: ignore[arg-type]
    resumed = learn(lights, 6, out=tmp_path / "m.fide", **words)  # type: ignore[arg-type]
    assert whole.emulator is not None
    assert resumed.emulator is not None
    assert seen == ["render", "render", "train", "train", "emulate"]
    for name, weight in whole.emulator.state_dict().items():
        assert torch.equal(weight, resumed.emulator.state_dict()[name]), name
    assert resumed.report.emulated == whole.report.emulated
