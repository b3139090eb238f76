"""Masks and weights of pixels."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fide_plugins import FIDE, losses
from fide_plugins.errors import ImageError
from fide_plugins.types import Float32, Float64
from fide_plugins.views import Views

Render = Callable[[Float64], Float32]
RNG = np.random.default_rng(4)
TARGET = RNG.random((20, 24, 3), np.float32)
WEIGHTS = RNG.random((20, 24), np.float32)
WEIGHTS.flat[7] = 1.0
HALF = np.zeros((20, 24), np.float32)
HALF[:, :12] = 1


def test_weighted_mse() -> None:
    images = RNG.random((3, 20, 24, 3), np.float32)
    squared = np.square(images.astype(np.float64) - TARGET).mean(axis=-1)
    expected = (WEIGHTS * squared).sum(axis=(1, 2)) / WEIGHTS.sum(dtype=np.float64)
    for given in ({"weights": WEIGHTS}, {"mask": WEIGHTS}, {"mask": WEIGHTS / 2}):
        opt = FIDE(3, TARGET, seed=0, **given)
        np.testing.assert_allclose(opt.evaluator.loss(images), expected, rtol=1e-6)


def test_mask_and_weights_multiply() -> None:
    views = Views.read(TARGET, HALF, WEIGHTS)
    product = HALF * WEIGHTS
    np.testing.assert_allclose(views.weights, product / product.max(), rtol=1e-6)


@pytest.mark.parametrize("mask", [np.ones((16, 16)), np.full((16, 16), 0.5), "white.png"])
def test_a_mask_that_hides_nothing_is_none(
    mask: Any, render: Render, target: Float32, tmp_path: Path
) -> None:
    if isinstance(mask, str):
        mask = tmp_path / mask
        Image.new("L", (16, 16), 255).save(mask)
    opt, plain = (FIDE(6, target, seed=0, popsize=8, mask=m) for m in (mask, None))
    assert opt.weights is None and opt.encoder.version == plain.encoder.version
    for _ in range(4):
        X = opt.ask()
        np.testing.assert_array_equal(X, plain.ask())
        opt.tell(X, render(X))
        plain.tell(X, render(X))


@pytest.mark.parametrize("encoder", ["dense", "patch"])
@pytest.mark.parametrize("loss", ["mse", "perceptual", "loi", None])
def test_what_is_hidden_has_no_influence(loss: str | None, encoder: str) -> None:
    """Whatever a renderer draws there, losses and tokens are the same to the last bit."""

    def brightness(images: Float32) -> Float64:
        values: Float64 = images.mean(axis=(1, 2, 3), dtype=np.float64)
        return values

    opt = FIDE(3, TARGET, loss=loss or brightness, encoder=encoder, mask=HALF, seed=0)
    images = RNG.random((2, 20, 24, 3), np.float32)
    other = np.where(HALF[..., None] == 1, images, RNG.random((2, 20, 24, 3), np.float32))
    np.testing.assert_array_equal(opt.evaluator.loss(images), opt.evaluator.loss(other))
    np.testing.assert_array_equal(opt.encoder(images), opt.encoder(other))
    right = np.where(HALF[..., None] == 1, TARGET, other)
    np.testing.assert_array_equal(opt.encoder(right)[0], opt.target_tokens)
    if loss is not None:
        assert opt.evaluator.loss(right).tolist() == [0.0, 0.0]
        assert opt.evaluator.loss(images).min() > 0


def test_mse_of_half_is_that_of_the_crop() -> None:
    images = RNG.random((3, 20, 24, 3), np.float32)
    crop = losses.make("mse", TARGET[:, :12])(images[:, :, :12])
    np.testing.assert_allclose(FIDE(3, TARGET, mask=HALF).evaluator.loss(images), crop, rtol=1e-12)


def test_half_weight_scales_the_square_in_every_loss() -> None:
    """X' = t + sqrt(w) (x - t): the callable sees squared differences times w."""
    seen: list[Float32] = []

    def look(images: Float32) -> Float64:
        seen.append(images)
        return np.zeros(len(images))

    opt = FIDE(3, TARGET, loss=look, weights=WEIGHTS, seed=0)
    images = RNG.random((1, 20, 24, 3), np.float32)
    opt.evaluator.loss(images)
    squared = np.square(images - TARGET) * WEIGHTS[..., None]
    np.testing.assert_allclose(np.square(seen[-1] - TARGET), squared, atol=1e-6)


def test_alpha_of_the_target(tmp_path: Path) -> None:
    pixels = np.dstack([TARGET, HALF])
    Image.fromarray((pixels * 255).astype(np.uint8)).save(tmp_path / "rgba.png")
    for target in (pixels, tmp_path / "rgba.png", [pixels]):
        views = Views.read(target, "alpha")
        np.testing.assert_array_equal(views.views[0].weights, HALF)
    with pytest.raises(ImageError, match=r"mask='alpha' must have an alpha channel.*\(20, 24, 3\)"):
        FIDE(3, TARGET, mask="alpha")


@pytest.mark.parametrize("form", ["bool", "uint8", "path", "PIL"])
def test_forms_of_masks(form: str, tmp_path: Path) -> None:
    gray = (HALF * 255).astype(np.uint8)
    Image.fromarray(gray).save(tmp_path / "m.png")
    forms = {"bool": HALF > 0, "uint8": gray, "path": tmp_path / "m.png"}
    mask: Any = forms.get(form, Image.fromarray(gray))
    np.testing.assert_array_equal(Views.read(TARGET, mask).weights, HALF)


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.zeros((20, 24)), "mask is zero everywhere"),
        (-HALF, r"mask must have values in \[0, 1\]"),
        (HALF * 2, r"mask must have values in \[0, 1\]"),
        (HALF * np.nan, "mask must be finite"),
        (HALF.T, r"mask must have .*20 x 24.*got 24 x 20"),
        (TARGET, "mask must be gray"),
        (HALF.astype(int), "mask must be uint8"),
        ("missing.png", "no image file at 'missing.png'"),
        ([HALF], "a list of masks or weights needs a list of targets"),
    ],
)
def test_wrong_masks(mask: Any, message: str) -> None:
    with pytest.raises(ImageError, match=message):
        FIDE(3, TARGET, mask=mask)


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (HALF, "mask must be a list with one entry for each of the 2 views.*got a single one"),
        ([HALF], "one entry for each of the 2 views.*got 1 of them"),
        ([None, HALF], "mask of view 1 must have .*9 x 8.*got 20 x 24"),
        ([HALF * 0, None], "mask of view 0 is zero everywhere"),
    ],
)
def test_wrong_masks_of_views(mask: Any, message: str) -> None:
    with pytest.raises(ImageError, match=message):
        FIDE(3, [TARGET, TARGET[:9, :8]], mask=mask)


def test_mask_times_weights_must_leave_something() -> None:
    with pytest.raises(ImageError, match="mask times weights is zero everywhere"):
        FIDE(3, TARGET, mask=HALF, weights=1 - HALF)


def test_features_of_another_mask_are_refused() -> None:
    one, other = FIDE(3, TARGET, mask=HALF, popsize=4), FIDE(3, TARGET, mask=1 - HALF, popsize=4)
    images = RNG.random((4, 20, 24, 3), np.float32)
    tokens = one.encoder(images)
    X = other.ask()
    with pytest.raises(ValueError, match="features must be by the optimizer's own encoder"):
        other.tell(X, losses=np.zeros(4), features=tokens, version=one.encoder.version)
    one.tell(one.ask(), losses=np.zeros(4), features=tokens, version=one.encoder.version)


def test_solved_is_judged_by_what_counts() -> None:
    opt = FIDE(3, TARGET, mask=HALF, popsize=4, seed=0)
    shown = np.where(HALF[..., None] == 1, TARGET, 0)
    opt.tell(opt.ask(), np.stack([shown] * 4))
    assert opt.status.code == "solved"
