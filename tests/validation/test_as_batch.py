from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from PIL import Image

from fide_plugins.errors import ImageError, ValueRangeError
from fide_plugins.validation.images import as_batch, as_target
from fide_plugins.validation.values import Clip

RGB = np.random.default_rng(1).random((4, 5, 7, 3), dtype=np.float32)
GRAY = RGB[..., 0]
BYTES = (RGB * 255).astype(np.uint8)
RGBA = np.concatenate([RGB, RGB[..., :1]], axis=3)


def test_a_canonical_batch_passes_through() -> None:
    assert as_batch(RGB) is RGB
    assert as_batch(RGB, (5, 7)) is RGB
    assert as_batch(RGB, (5, 7, 3), n=4) is RGB


@pytest.mark.parametrize(
    ("batch", "single"),
    [
        pytest.param(BYTES, BYTES, id="uint8"),
        pytest.param(GRAY, GRAY, id="nHW"),
        pytest.param(RGBA, RGBA, id="nHW4"),
        pytest.param(np.moveaxis(np.moveaxis(RGB, -1, 1).copy(), 1, -1), RGB, id="moved axis"),
        pytest.param(torch.from_numpy(RGB).permute(0, 3, 1, 2), RGB, id="nCHW tensor"),
        pytest.param(list(RGB), RGB, id="list"),
        pytest.param(tuple(torch.from_numpy(RGB).permute(0, 3, 1, 2)), RGB, id="CHW tensors"),
        pytest.param([Image.fromarray(x) for x in BYTES], BYTES, id="PIL images"),
    ],
)
@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3), None])
def test_a_batch_is_its_images(batch: Any, single: np.ndarray, shape: Any) -> None:
    out = as_batch(batch, shape, n=4)
    assert out.dtype == np.float32 and out.flags.c_contiguous
    np.testing.assert_array_equal(out, np.stack([as_target(image) for image in single]))


def test_the_size_tells_tensor_axes_apart() -> None:
    tensor = torch.rand((2, 3, 5, 4), generator=torch.Generator().manual_seed(0))
    np.testing.assert_array_equal(as_batch(tensor, (5, 4)), tensor.permute(0, 2, 3, 1).numpy())
    np.testing.assert_array_equal(as_batch(tensor[..., :3], (3, 5)), tensor[..., :3].numpy())


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (RGB[:, :4], r"target's size, 5 x 7 \(H x W\), got 4 x 7.*\(4, 4, 7, 3\)"),
        ([RGB[0], RGB[1, :4]], r"image 1 must have the target's size, 5 x 7.*got 4 x 7"),
        (RGB[0], r"\(n, H, W, C\).*\(5, 7, 3\).*image\[None\]"),
        (GRAY[0], r"\(n, H, W, C\).*\(5, 7\).*image\[None\]"),
        (np.moveaxis(RGB, -1, 1), r"1, 3 or 4 channels.*\(4, 3, 5, 7\).*np.moveaxis"),
        (torch.zeros(4, 2, 5, 7), r"1, 3 or 4 channels.*\(4, 2, 5, 7\)"),
        (RGB[None], r"axes \(n, H, W, C\).*\(1, 4, 5, 7, 3\)"),
        (RGB.astype(int), r"uint8.*int64"),
        (np.zeros((4, 0, 7, 3)), r"empty.*\(4, 0, 7, 3\)"),
        (np.where(RGB > 0.9, np.nan, RGB), r"batch of images must be finite.*NaN"),
        ([RGB[0], RGB[1] * np.inf], r"image 1 must be finite"),
        ([RGB[0], None], r"image 1 is None.*withdraw"),
        ("a.png", r"array or a list of images, got a\.png"),
        (Image.fromarray(BYTES[0]), r"array or a list of images"),
        (None, r"NoneType"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_refused(images: Any, message: str) -> None:
    with pytest.raises(ImageError, match=f"(?s){message}"):
        as_batch(images, (5, 7))


@pytest.mark.parametrize("images", [RGB, list(RGB)])
def test_one_image_per_point(images: Any) -> None:
    with pytest.raises(ImageError, match=r"got 4 images for 3 points"):
        as_batch(images, (5, 7), n=3)


@pytest.mark.parametrize("make", [np.asarray, list], ids=["array", "list"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_values_outside_are_clipped_with_one_warning(make: Any, dtype: Any) -> None:
    images = RGB.astype(dtype)
    images[0, 0, 0] = 1e30
    images[2, 0, 0] = -3.0
    with pytest.warns(RuntimeWarning, match=r"1e\+30.*clipped to \[0, 1\]") as record:
        clipped = as_batch(make(images), (5, 7))
    assert len(record) == 1
    np.testing.assert_array_equal(clipped, np.clip(images, 0, 1).astype(np.float32))
    assert images[0, 0, 0, 0] > 1  # the caller's array is left alone


def test_the_caller_decides_about_the_warning() -> None:
    told: list[Clip] = []
    as_batch(RGB * 3, (5, 7), on_clip=told.append)
    assert len(told) == 1 and told[0].images == 4
    assert "give value_range=(0, 2." in str(told[0]) and "255" not in str(told[0])


@settings(max_examples=50, deadline=None)
@given(
    st.sampled_from([np.float16, np.float32, np.float64, np.uint8, np.bool_]),
    st.integers(0, 3),
    st.tuples(st.integers(1, 5), st.integers(1, 5)),
    st.sampled_from([1, 3, 4]),
    st.integers(0, 2**32 - 1),
)
def test_any_batch_becomes_canonical(
    dtype: Any, n: int, size: tuple[int, int], channels: int, seed: int
) -> None:
    values = np.random.default_rng(seed).random((n, *size, channels))
    images = (values * 255 if dtype == np.uint8 else values).astype(dtype)
    out = as_batch(images, size)
    assert out.shape == (n, *size, 3) and out.dtype == np.float32 and out.flags.c_contiguous
    assert n == 0 or (out.min() >= 0 and out.max() <= 1)


@pytest.mark.parametrize(
    "images",
    [
        np.random.default_rng(0).uniform(0, 255, (2, 6, 5, 3)),
        np.random.default_rng(0).integers(0, 256, (2, 6, 5, 3)).astype(np.float32),
        (np.arange(60).reshape(1, 4, 5, 3) == 7) * 255.0,  # one bright value: mean 4, whole numbers
    ],
    ids=["any", "whole", "dark"],
)
def test_floats_of_bytes_raise_as_a_target_does(images: Any) -> None:
    whole = bool((images == np.rint(images)).all())
    for told in (images, list(images)):
        with pytest.raises(ValueRangeError, match="divide by 255" if whole else "another scale"):
            as_batch(told)
    with pytest.raises(ImageError, match="divide by 255" if whole else "value_range=.*same number"):
        as_target(images[0])
