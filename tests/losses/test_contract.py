"""What every loss promises, and how losses are resolved."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from fide_plugins import losses
from fide_plugins.errors import ImageError, LossError, UnknownNameError
from fide_plugins.types import Float32

RNG = np.random.default_rng(5)
SIZES = [(1, 1), (1, 9), (5, 4), (33, 57), (16, 512), (112, 112)]
SMALLEST = {"lpips": 31, "texture": 8}  # side of the smallest image, where there is one

every_loss = pytest.mark.parametrize("name", losses.names())


@pytest.fixture(autouse=True)
def weights_of_lpips(cached_weights: Path) -> None:
    """Random ones."""


@every_loss
@pytest.mark.parametrize("size", SIZES)
def test_zero_at_the_target_and_positive_elsewhere(name: str, size: tuple[int, int]) -> None:
    size = max(size[0], SMALLEST.get(name, 1)), max(size[1], SMALLEST.get(name, 1))
    target = RNG.random((*size, 3), dtype=np.float32)
    images = np.stack([target, 1 - target, target, np.zeros_like(target)])
    values = losses.make(name, target)(images)
    assert values.dtype == np.float64 and values.shape == (4,)
    assert values[0] == values[2] == 0.0
    assert np.all(values[[1, 3]] > 0) and np.isfinite(values).all()
    assert losses.make(name, target)(images[:0]).shape == (0,)


@every_loss
@settings(max_examples=8, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_a_value_does_not_depend_on_the_batch(
    name: str, height: int, width: int, n: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    height, width = (side + SMALLEST.get(name, 1) - 1 for side in (height, width))
    target, *images = rng.random((n + 1, height, width, 3), dtype=np.float32)
    loss = losses.make(name, target)
    together = loss(np.stack(images))
    alone = [loss(image[None])[0] for image in images]
    assert together.tolist() == alone
    assert loss(np.stack(images[::-1])).tolist() == alone[::-1]
    assert losses.make(name, target)(images).tolist() == alone


@pytest.mark.parametrize("name", sorted({*losses.names()} - {"texture"}))  # weighs by its target
def test_symmetric(name: str) -> None:
    a, b = RNG.random((2, 32, 40, 3), dtype=np.float32)
    forth, back = losses.make(name, a)(b[None]), losses.make(name, b)(a[None])
    np.testing.assert_allclose(forth, back, rtol=1e-5)


@every_loss
def test_the_target_is_kept_safe(name: str) -> None:
    target = RNG.random((36, 36, 3), dtype=np.float32)
    images = RNG.random((2, 36, 36, 3), dtype=np.float32)
    loss = losses.make(name, target)
    before, kept = loss(images), images.copy()
    target[:] = 0
    np.testing.assert_array_equal(loss(images), before)
    np.testing.assert_array_equal(images, kept)
    with pytest.raises(ValueError, match="read-only"):
        loss.target[:] = 0


@every_loss
def test_any_target_and_images(name: str) -> None:
    target = RNG.integers(0, 256, (36, 38, 3), np.uint8)
    image = RNG.integers(0, 256, (36, 38, 3), np.uint8)
    expected = losses.make(name, target / np.float32(255))(image[None] / np.float32(255))
    as_tensor = torch.from_numpy(image).permute(2, 0, 1)
    assert losses.make(name, torch.from_numpy(target).permute(2, 0, 1))([as_tensor]) == expected
    loss = losses.make(name, target)
    with pytest.raises(ImageError, match="target's size, 36 x 38"):
        loss(np.zeros((1, 38, 36, 3)))
    with pytest.raises(ImageError, match="finite"):
        loss(np.full((1, 36, 38, 3), np.inf))


@every_loss
def test_named_and_versioned(name: str) -> None:
    loss = losses.make(name, np.zeros((40, 40)))
    assert loss.name == name and loss.version.startswith(f"{name}-")


# -- resolve ---------------------------------------------------------------------------------------

TARGET = RNG.random((6, 5, 3), dtype=np.float32)
IMAGES = RNG.random((3, 6, 5, 3), dtype=np.float32)


def brightness(images: Float32) -> Float32:
    means: Float32 = images.mean(axis=(1, 2, 3))
    return means


def test_names_and_none() -> None:
    assert losses.resolve(None, TARGET).name == "mse"
    assert losses.resolve("loi", TARGET).name == "loi"
    np.testing.assert_array_equal(
        losses.resolve(None, TARGET)(IMAGES), losses.make("mse", TARGET)(IMAGES)
    )
    with pytest.raises(UnknownNameError, match="loi, lpips, mse, perceptual"):
        losses.resolve("msee", TARGET)


def test_a_made_loss_must_be_of_this_target() -> None:
    loss = losses.make("loi", TARGET)
    assert losses.resolve(loss, TARGET) is loss
    with pytest.raises(LossError, match=r"'loi' was made for another target.*\(6, 5, 3\)"):
        losses.resolve(loss, IMAGES[0])


def test_a_callable() -> None:
    loss = losses.resolve(brightness, TARGET)
    assert loss.name == "brightness"
    np.testing.assert_allclose(loss(IMAGES), brightness(IMAGES))
    with pytest.raises(ImageError, match="target's size"):
        loss(IMAGES[:, :4])


@pytest.mark.parametrize(
    "give",
    [
        lambda images: torch.from_numpy(images).mean(dim=(1, 2, 3)).requires_grad_(),
        lambda images: images.mean(axis=(1, 2, 3)).tolist(),
        lambda images: images.mean(axis=(1, 2, 3), keepdims=True)[..., 0, 0],
        lambda images: [np.float32(image.mean()) for image in images],
    ],
    ids=["tensor", "list", "column", "scalars"],
)
def test_forms_of_values(give: Callable[[Any], object]) -> None:
    values = losses.resolve(give, TARGET)(IMAGES)
    assert values.dtype == np.float64 and values.shape == (3,)
    np.testing.assert_allclose(values, brightness(IMAGES), rtol=1e-6)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([1.0, 2.0], r"3 numbers, one per image, got shape \(2,\)"),
        (1.0, r"3 numbers, one per image, got shape \(\)"),
        (np.zeros((3, 2)), r"3 numbers, one per image, got shape \(3, 2\)"),
        (np.zeros((3, 3)), r"3 numbers, one per image, got shape \(3, 3\)"),
        (["a", "b", "c"], r"real numbers, got <U1 \(list\)"),
        (None, r"real numbers, got object \(NoneType\)"),
        (np.zeros(3, complex), r"real numbers, got complex128"),
        ([[1.0], [1.0, 2.0], [3.0]], r"3 numbers, one per image: "),
    ],
)
def test_wrong_values_are_refused(values: object, message: str) -> None:
    loss = losses.resolve(lambda images: values, TARGET)
    with pytest.raises(LossError, match=f"(?s)the loss '<lambda>' must be {message}") as error:
        loss(IMAGES)
    assert isinstance(error.value, ValueError)


def test_a_loss_that_writes_to_its_images_does_no_harm() -> None:
    def rude(images: Float32) -> np.ndarray:
        images[:] = 0
        return np.zeros(len(images))

    before = IMAGES.copy()
    losses.resolve(rude, TARGET)(IMAGES)
    np.testing.assert_array_equal(IMAGES, before)


@pytest.mark.parametrize("loss", [3, ["mse"], b"mse"])
def test_what_is_no_loss(loss: Any) -> None:
    with pytest.raises(LossError, match="a loss is a name"):
        losses.resolve(loss, TARGET)
