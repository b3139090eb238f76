"""A user's own encoder: any callable of a batch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins import FIDE, encoders
from fide_plugins.errors import CheckpointError, FeaturesError
from fide_plugins.types import Float32

Encoder = Callable[[Float32], Any]


def quarters(images: Float32) -> Float32:
    """Mean colors of four quarters, (n, 4, 3)."""
    n, height, width, _ = images.shape
    blocks = images.reshape(n, 2, height // 2, 2, width // 2, 3)
    means: Float32 = blocks.mean(axis=(2, 4)).reshape(n, 4, 3)
    return means


def test_it_is_what_the_optimizer_uses(render: Any, target: Float32) -> None:
    opt = FIDE(6, target, encoder=quarters, popsize=8, seed=0)
    assert tuple(opt.target_tokens.shape) == (4, 3)
    assert opt.encoder.name == "quarters" == opt.options.encoder
    assert opt.encoder.version == "own:quarters"
    np.testing.assert_array_equal(opt.target_tokens, quarters(target[None])[0])
    for _ in range(16):
        X = opt.ask()
        opt.tell(X, render(X))
    assert opt.best is not None and opt.best.loss < 0.01


@pytest.mark.parametrize(
    "form",
    [
        lambda images: torch.from_numpy(quarters(images)).requires_grad_(),
        lambda images: quarters(images).astype(np.float64),
        lambda images: quarters(images).tolist(),
    ],
    ids=["tensor", "double", "list"],
)
def test_forms_of_features(form: Encoder, target: Float32) -> None:
    opt = FIDE(6, target, encoder=form, seed=0)
    np.testing.assert_array_equal(opt.target_tokens, quarters(target[None])[0])
    assert opt.target_tokens.dtype == torch.float32 and not opt.target_tokens.requires_grad


def test_one_vector_is_one_token(target: Float32) -> None:
    opt = FIDE(6, target, encoder=lambda images: images.mean(axis=(1, 2)), seed=0)
    assert tuple(opt.target_tokens.shape) == (1, 3)


@pytest.mark.parametrize(
    ("encoder", "message"),
    [
        (lambda images: images, r"\(n, T, C\) or \(n, C\).*the shape \(2, 16, 16, 3\)"),
        (lambda images: quarters(images)[:1], r"the shape \(1, 4, 3\) for n = 2"),
        (lambda images: quarters(images) > 0.5, "torch.bool"),
        (lambda images: quarters(images) / 0.0, "finite floats.*torch.float32"),
        (lambda images: "features", "finite floats"),
        (lambda images: None, "returned NoneType"),
        (lambda images: quarters(images) - quarters(images).mean(0), "same values in every"),
        (lambda images: images.permute(0, 3, 1, 2), "tried on two images.*AttributeError"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*divide by zero", "ignore:.*invalid value")
def test_a_wrong_encoder_is_refused_before_the_first_render(
    encoder: Encoder, message: str, target: Float32
) -> None:
    with pytest.raises(FeaturesError, match=f"(?s){message}"):
        FIDE(6, target, encoder=encoder)


def test_views_of_several_sizes(target: Float32) -> None:
    small = target[:8, :6]
    opt = FIDE(6, [target, small], encoder=quarters, seed=0)
    assert tuple(opt.target_tokens.shape) == (8, 3)
    np.testing.assert_array_equal(opt.target_tokens[4:], quarters(small[None])[0])


@pytest.fixture
def registered() -> Iterator[str]:
    encoders.register("quarters-of-tests", lambda device: quarters)
    yield "quarters-of-tests"
    del encoders._REGISTRY._factories["quarters-of-tests"]


def test_a_registered_encoder_is_saved_by_name(
    registered: str, render: Any, target: Float32, tmp_path: Path
) -> None:
    assert registered in encoders.names()
    opt = FIDE(6, target, encoder=registered, popsize=8, seed=0)
    X = opt.ask()
    opt.tell(X, render(X))
    opt.save(tmp_path / "c")
    np.testing.assert_array_equal(FIDE.load(tmp_path / "c").ask(), opt.ask())


def test_a_passed_encoder_cannot_be_loaded(target: Float32, tmp_path: Path) -> None:
    FIDE(6, target, encoder=quarters, popsize=8, seed=0).save(tmp_path / "c")
    with pytest.raises(CheckpointError, match="register what it names first"):
        FIDE.load(tmp_path / "c")
