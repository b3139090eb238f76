"""Features in place of images: the same run, for users who encode where they render."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins import encoders
from fide_plugins.errors import FeaturesError, FideError
from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64

from .helpers import Render, StateOf


def losses_of(images: Float32, target: Float32) -> Float64:
    squares: Float64 = np.square(images.astype(np.float64) - target).mean(axis=(1, 2, 3))
    return squares


@pytest.mark.parametrize("encoder", ["dense", "patch"])
def test_features_are_as_good_as_the_images(encoder: str, render: Render, target: Float32) -> None:
    encode = encoders.make(encoder)
    here, elsewhere = (FIDE(6, target, encoder=encoder, popsize=8, seed=0) for _ in range(2))
    for _ in range(6):
        X = here.ask()
        np.testing.assert_array_equal(elsewhere.ask(), X)
        images = render(X)
        losses = losses_of(images, target)
        here.tell(X, images, losses)
        elsewhere.tell(X, losses=losses, features=encode(images))
    assert here.best is not None and elsewhere.best is not None
    assert elsewhere.best.loss == here.best.loss
    assert elsewhere.best.image is None  # it never was here


@pytest.mark.parametrize("form", ["list", "array", "float64", "float16"])
def test_forms_of_features(form: str, render: Render, target: Float32) -> None:
    opt, same = (FIDE(6, target, popsize=4, seed=0) for _ in range(2))
    X = opt.ask()
    tokens = encoders.make("dense")(render(X)).half().float()  # of few digits: the same in all
    given: Any = {
        "list": list(tokens),
        "array": tokens.numpy(),
        "float64": tokens.double(),
        "float16": tokens.half(),
    }[form]
    opt.tell(X, losses=np.arange(4.0), features=given)
    same.ask()
    same.tell(X, losses=np.arange(4.0), features=tokens)
    np.testing.assert_array_equal(opt.ask(), same.ask())


BAD: dict[str, tuple[Callable[[torch.Tensor], Any], str]] = {
    "one too many": (lambda t: torch.cat([t, t[:1]]), r"\(n, T, C\) = \(4, 196, 16\).*\(5, 196"),
    "another encoder": (lambda t: t[..., :3], r"'dense'.*\(4, 196, 3\)"),
    "no axis for n": (lambda t: t[0], r"\(196, 16\)"),
    "whole numbers": (lambda t: t.to(torch.uint8), "finite floats.* of uint8"),
    "text": (lambda t: "features", "finite floats"),
    "ragged": (lambda t: [t[0], t[1], t[2], t[3, 1:]], "same shape"),
    "NaN": (lambda t: t * float("nan"), "finite"),
    "infinite": (lambda t: t + float("inf"), "finite"),
    "too large": (lambda t: t.double().numpy() + 1e300, "finite"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_features_change_nothing(
    what: str, render: Render, target: Float32, state_of: StateOf
) -> None:
    change, message = BAD[what]
    opt = FIDE(6, target, popsize=4, seed=0)
    X = opt.ask()
    before = state_of(opt)
    features = change(encoders.make("dense")(render(X)))
    with pytest.raises(FeaturesError, match=f"(?s){message}") as caught:
        opt.tell(X, losses=np.arange(4.0), features=features)
    assert isinstance(caught.value, ValueError) and isinstance(caught.value, FideError)
    assert state_of(opt) == before


def test_features_of_another_version_are_refused(
    render: Render, target: Float32, state_of: StateOf
) -> None:
    """Though they look alike; who says nothing of the version vouches for it."""
    opt, same = (FIDE(6, target, popsize=4, seed=0) for _ in range(2))
    X = opt.ask()
    same.ask()
    before = state_of(opt)
    encoder = encoders.make("dense")
    tokens = encoder(render(X))
    message = rf"'{encoder.version}', not 'dense-0'; encode the images again"
    with pytest.raises(FeaturesError, match=message):
        opt.tell(X, losses=np.arange(4.0), features=tokens, version="dense-0")
    assert state_of(opt) == before
    opt.tell(X, losses=np.arange(4.0), features=tokens, version=encoder.version)
    same.tell(X, losses=np.arange(4.0), features=tokens)
    np.testing.assert_array_equal(opt.ask(), same.ask())
