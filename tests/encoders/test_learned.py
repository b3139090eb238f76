"""The encoder of a model, by its name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fide_lab import optimizers
from fide_plugins import FIDE, encoders
from fide_plugins.errors import (
    CheckpointError,
    ImageError,
    WeightsNotFoundError,
)
from fide_plugins.learning import Model
from fide_plugins.types import Float64

RNG = np.random.default_rng(0)
SIDE = 32  # of the model


def pictures(n: int, side: int = SIDE) -> Float64:
    return RNG.random((n, side, side, 3))


@pytest.fixture
def saved(random_model: Callable[..., Model], tmp_path: Path) -> Path:
    path = tmp_path / "model.fide"
    random_model((SIDE, SIDE)).save(path)
    return path


def test_tokens_are_the_feature_map_of_the_model(saved: Path) -> None:
    model = Model.load(saved)
    images = RNG.integers(0, 256, (5, SIDE, SIDE, 3), np.uint8)
    tokens = encoders.make(f"learned:{saved}")(images)
    with torch.no_grad():
        inputs = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255
        places = model.network.encoder(inputs)[0]
    assert tokens.shape == places.shape == (5, 64, 96)
    torch.testing.assert_close(tokens, places, rtol=1e-4, atol=1e-5)


def test_larger_images_are_reduced_by_means_of_areas(saved: Path) -> None:
    small = pictures(3)
    large = small.repeat(3, axis=1).repeat(3, axis=2)
    encoder = encoders.make(f"learned:{saved}")
    torch.testing.assert_close(encoder(large), encoder(small), rtol=1e-4, atol=1e-5)


def test_another_aspect_is_refused_before_anything_is_made(saved: Path) -> None:
    with pytest.raises(ImageError, match=r"learned images of 32 x 32 .* this picture is 48 x 32"):
        FIDE(3, np.zeros((SIDE, 48, 3)), encoder=f"learned:{saved}")


@pytest.mark.parametrize("name", ["learned", "learned:"])
def test_without_a_file_it_says_where_one_comes_from(name: str) -> None:
    with pytest.raises(WeightsNotFoundError, match=r"needs the file of a model: `fide learn`"):
        encoders.make(name)


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(WeightsNotFoundError, match=r"no model at .*absent\.fide: No such file"):
        encoders.make(f"learned:{tmp_path / 'absent.fide'}")
    with pytest.raises(WeightsNotFoundError, match="is a folder; name the model's file"):
        encoders.make(f"learned:{tmp_path}")


def test_damaged_and_other_files_are_refused(saved: Path) -> None:
    whole = saved.read_bytes()
    FIDE(2, pictures(1)[0], seed=0).save(saved.parent / "run")
    for contents in (whole[:-40], b"", whole[:200] + b"\xff" + whole[201:]):
        (saved.parent / "bad").write_bytes(contents)
        with pytest.raises(CheckpointError, match="bad"):
            encoders.make(f"learned:{saved.parent / 'bad'}")
    with pytest.raises(CheckpointError, match="learned model"):
        encoders.make(f"learned:{saved.parent / 'run'}")


def test_weights_that_are_not_finite_are_refused(saved: Path) -> None:
    model = Model.load(saved)
    model.network.encoder.mix.weight.data[0] = torch.nan
    model.save(saved)
    with pytest.raises(CheckpointError, match=r"mix\.weight.* no array of finite numbers"):
        encoders.make(f"learned:{saved}")


def images_of(X: Float64) -> Float64:
    ramp = np.linspace(0, 1, SIDE)[:, None, None]
    return np.stack([np.broadcast_to(ramp * x[:3], (SIDE, SIDE, 3)) for x in X])


def advance(opt: FIDE, generations: int) -> list[Float64]:
    asked = []
    for _ in range(generations):
        asked.append(opt.ask())
        opt.tell(asked[-1], images_of(asked[-1]))
    return asked


def test_a_saved_optimizer_goes_on_with_its_model(saved: Path) -> None:
    target, name = images_of(np.full((1, 3), 0.3))[0], f"learned:{saved}"
    whole = advance(FIDE(3, target, encoder=name, seed=4), 8)
    opt = FIDE(3, target, encoder=name, seed=4)
    assert opt.options.encoder == name
    first = advance(opt, 4)
    opt.save(saved.parent / "run")
    again = FIDE.load(saved.parent / "run")
    np.testing.assert_array_equal(np.concatenate(whole), np.concatenate(first + advance(again, 4)))


@pytest.mark.parametrize("name", ["fide", "eki", "fide-annealing"])
def test_a_saved_optimizer_refuses_another_model(
    name: str, saved: Path, random_model: Callable[..., Model]
) -> None:
    opt: Any = optimizers.make(name, 3, pictures(1)[0], encoder=f"learned:{saved}", seed=4)
    opt.save(saved.parent / "run")
    random_model((SIDE, SIDE), seed=1).save(saved)
    with pytest.raises(CheckpointError, match="features of the encoder learned-1-") as raised:
        optimizers.load(name, saved.parent / "run")
    assert f"put that model back, which encoder='learned:{saved}' reads" in str(raised.value)
    assert "impossible contents" not in str(raised.value)
    saved.unlink()
    with pytest.raises(WeightsNotFoundError, match="no model at"):
        optimizers.load(name, saved.parent / "run")
