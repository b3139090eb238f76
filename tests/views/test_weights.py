"""Masks and weights of pixels."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from fide_plugins import FIDE
from fide_plugins.errors import ImageError
from fide_plugins.types import Float32, Float64
from fide_plugins.views import Views

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


WILD = [np.nan, np.inf, -3.0, 50.0, 255.0]


def hidden_as(images: Any, value: Any) -> Any:
    """Images (..., 20, 24, C) with that value where the mask HALF is 0."""
    return np.where(HALF[..., None] == 1, images, value)


@pytest.mark.parametrize("form", ["float32", "float64", "gray", "RGBA", "list", "tensor"])
@pytest.mark.parametrize("value", WILD)
def test_hidden_pixels_may_have_any_value(value: float, form: str) -> None:
    """A ray that misses is NaN, a hole in a depth picture 255: no error, and no warning."""
    images = RNG.random((3, 20, 24, {"gray": 1, "RGBA": 4}.get(form, 3)), np.float32)
    wild = hidden_as(images, np.float64(value)).astype("f8" if form == "float64" else "f4")
    forms: dict[str, Callable[[Any], Any]] = {"list": list, "tensor": torch.from_numpy}
    given = forms.get(form, np.asarray)(wild)
    one, other = (FIDE(3, TARGET, mask=HALF, popsize=4, seed=0) for _ in range(2))
    X = one.ask(3)
    np.testing.assert_array_equal(one.tell(X, given), other.tell(other.ask(3), images))
    np.testing.assert_array_equal(one.encoder(given), other.encoder(images))
    np.testing.assert_array_equal(one.evaluator.loss(given), other.evaluator.loss(images))
    found: list[Any] = [one.best, other.best]
    shown, expected = (solution.image for solution in found)
    np.testing.assert_array_equal(shown[:, :12], expected[:, :12])
    if form != "RGBA":  # 0 for NaN, then composited
        np.testing.assert_array_equal(shown[:, 12:], np.clip(np.nan_to_num(value, nan=0), 0, 1))


@pytest.mark.parametrize("value", WILD)
def test_the_target_may_have_any_value_where_it_is_hidden(value: float) -> None:
    plain, wild = (FIDE(3, hidden_as(TARGET, v), mask=HALF, seed=0) for v in (0.0, value))
    images = RNG.random((2, 20, 24, 3), np.float32)
    np.testing.assert_array_equal(plain.evaluator.loss(images), wild.evaluator.loss(images))
    other = hidden_as(1 - TARGET, value)
    wild.retarget(other)
    np.testing.assert_array_equal(wild.target[:, :12], other[:, :12].astype(np.float32))
    assert np.isfinite(wild.target).all()
    views = Views.read([TARGET, hidden_as(TARGET, value)], [None, HALF]).retargeted(
        [1 - TARGET, other]
    )
    np.testing.assert_array_equal(views.targets[1], wild.target)
    np.testing.assert_array_equal(views.weights[1], HALF)
    rgba = np.dstack([hidden_as(TARGET, value), HALF])
    assert np.isfinite(Views.read(rgba, "alpha").target).all()


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


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
@pytest.mark.parametrize("form", ["array", "tensor", "PIL", "path"])
def test_what_is_transparent_in_a_mask_is_hidden(form: str, mode: str, tmp_path: Path) -> None:
    """White where it counts and nothing elsewhere: over white it would hide nothing."""
    white = np.full((20, 24, 3), 255, np.uint8)
    rgba = np.dstack([white, (HALF * 255).astype(np.uint8)])
    image = Image.fromarray(rgba).convert(mode)
    image.save(tmp_path / "m.png")
    forms = {"array": rgba, "tensor": torch.from_numpy(rgba), "PIL": image}
    mask: Any = forms.get(form, tmp_path / "m.png")
    np.testing.assert_array_equal(Views.read(TARGET, mask).weights, HALF)
    np.testing.assert_array_equal(Views.read(TARGET, weights=mask).weights, HALF)


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.zeros((20, 24)), "mask is zero everywhere"),
        (-HALF, r"mask must have values in \[0, 1\]"),
        (HALF * 2, r"mask must have values in \[0, 1\]"),
        (HALF * np.nan, "mask must be finite"),
        (HALF.T, r"mask must have .*20 x 24.*got 24 x 20.*float32; give it that size$"),
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
        (HALF, "one entry for each of the 2 views.*a single one.*one size, not 20 x 24 \\+ 9 x 8"),
        ([HALF], "one entry for each of the 2 views.*got 1 of them"),
        ([None, HALF], "mask of view 1 must have .*9 x 8.*got 20 x 24"),
        ([HALF * 0, None], "mask of view 0 is zero everywhere"),
    ],
)
def test_wrong_masks_of_views(mask: Any, message: str) -> None:
    with pytest.raises(ImageError, match=message):
        FIDE(3, [TARGET, TARGET[:9, :8]], mask=mask)


@pytest.mark.parametrize("form", ["array", "path", "PIL", "tensor"])
@pytest.mark.parametrize("name", ["mask", "weights"])
def test_a_single_mask_counts_for_all_views_of_its_size(
    name: str, form: str, tmp_path: Path
) -> None:
    picture = Image.fromarray((HALF * 255).astype(np.uint8))
    picture.save(tmp_path / "m.png")
    forms = {"array": HALF, "path": tmp_path / "m.png", "PIL": picture}
    given: Any = forms.get(form, torch.from_numpy(HALF))
    targets = [TARGET, 1 - TARGET]
    one, each = (Views.read(targets, **{name: m}) for m in (given, [HALF, HALF]))
    assert one.version == each.version
    for weights in one.weights:
        np.testing.assert_array_equal(weights, HALF)
    with pytest.raises(ImageError, match=f"{name} of view 0 must have .*20 x 24.*got 9 x 24"):
        Views.read(targets, **{name: HALF[:9]})


def test_mask_times_weights_must_leave_something() -> None:
    with pytest.raises(ImageError, match="mask times weights is zero everywhere"):
        FIDE(3, TARGET, mask=HALF, weights=1 - HALF)


def test_solved_is_judged_by_what_counts() -> None:
    opt = FIDE(3, TARGET, mask=HALF, popsize=4, seed=0)
    shown = np.where(HALF[..., None] == 1, TARGET, 0)
    opt.tell(opt.ask(), np.stack([shown] * 4))
    assert opt.status.code == "solved"


def test_alpha_of_whole_numbers_is_a_share_with_a_value_range() -> None:
    target = RNG.integers(0, 65536, (20, 24, 4), np.uint16)
    views = Views.read(target, mask="alpha", value_range=(0, 65535))
    weights = views.weights
    np.testing.assert_allclose(weights, target[..., 3] / target[..., 3].max(), rtol=1e-6)
