import re
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

from fide_plugins.errors import FideError, ImageError, ImageNotFoundError, OptionError
from fide_plugins.validation.images import as_batch, as_target, load, save
from fide_plugins.validation.values import MAX_PIXELS

RGB = np.random.default_rng(0).random((5, 7, 3), dtype=np.float32)
BYTES = np.arange(5 * 7 * 3, dtype=np.uint8).reshape(5, 7, 3)
GRAY = RGB[..., 0]


def canonical(image: np.ndarray) -> bool:
    return image.dtype == np.float32 and image.ndim == 3 and bool(image.flags.c_contiguous)


@pytest.mark.parametrize(
    ("given_image", "expected"),
    [
        pytest.param(RGB, RGB, id="canonical"),
        pytest.param(RGB.astype(np.float64), RGB, id="float64"),
        pytest.param(RGB.astype(np.float16), RGB.astype(np.float16).astype(np.float32), id="half"),
        pytest.param(BYTES, BYTES / np.float32(255), id="uint8"),
        pytest.param(RGB > 0.5, (RGB > 0.5).astype(np.float32), id="bool"),
        pytest.param(GRAY, np.repeat(GRAY[..., None], 3, 2), id="HxW"),
        pytest.param(torch.from_numpy(RGB), RGB, id="HWC tensor"),
        pytest.param(torch.from_numpy(RGB).permute(2, 0, 1), RGB, id="CHW tensor"),
        pytest.param(torch.from_numpy(GRAY)[None], np.repeat(GRAY[..., None], 3, 2), id="1HW"),
        pytest.param(
            torch.from_numpy(RGB).bfloat16(),
            torch.from_numpy(RGB).bfloat16().float().numpy(),
            id="bfloat16",
        ),
        pytest.param(Image.fromarray(BYTES), BYTES / np.float32(255), id="PIL"),
        pytest.param(RGB.tolist(), RGB, id="nested list"),
        pytest.param(np.full((2, 2, 3), 1 + 5e-7), np.ones((2, 2, 3), np.float32), id="rounding"),
    ],
)
def test_conversions(given_image: Any, expected: np.ndarray) -> None:
    target = as_target(given_image)
    assert canonical(target)
    np.testing.assert_array_equal(target, expected)


def test_alpha_is_composited_over_white() -> None:
    rgba = np.array([[[0.5, 0.0, 1.0, 1.0], [0.5, 0.0, 1.0, 0.0], [0.5, 0.0, 1.0, 0.25]]])
    expected = [[[0.5, 0.0, 1.0], [1.0, 1.0, 1.0], [0.875, 0.75, 1.0]]]
    np.testing.assert_array_equal(as_target(rgba), np.array(expected, np.float32))


def test_a_mask_is_never_lost() -> None:
    """That of `np.ma`; an array of which nothing is masked is an array."""
    masked = np.ma.MaskedArray(RGB, mask=RGB > 2)
    np.testing.assert_array_equal(as_target(masked), RGB)
    masked[1, 2] = np.ma.masked
    for convert, image in ((as_target, masked), (as_batch, masked[None]), (as_batch, [masked])):
        with pytest.raises(ImageError, match=r"masked array.*\.filled\(value\).*mask="):
            convert(image)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((3, 5, 7)), r"1, 3 or 4 channels in its last axis.*\(3, 5, 7\).*np.moveaxis"),
        (torch.zeros(2, 5, 7), r"1, 3 or 4 channels.*\(2, 5, 7\).*make views: list"),
        (np.zeros(5), r"\(H, W\) or \(H, W, C\).*\(5,\)"),
        (np.zeros((2, 5, 7, 3)), r"\(H, W, C\).*\(2, 5, 7, 3\).*make views: list"),
        (torch.zeros(1, 3, 5, 7), r"\(1, 3, 5, 7\).*; take an image out of its batch, image\[0\]"),
        (np.zeros((0, 7, 3)), r"empty.*\(0, 7, 3\)"),
        (np.zeros((5, 7, 3), np.int64), r"uint8 in \[0, 255\].*int64; divide by .*image / 65535"),
        (torch.zeros(5, 7, 3, dtype=torch.int32), r"uint8.*int32; divide by the value .* white"),
        (RGB.astype(complex), r"complex128; give an array of numbers"),
        (5, "got int; give an array of numbers, a path, a PIL image"),
        (np.full((5, 7, 3), 128.0), r"in \[0, 1\].*\[128, 128\].*divide by 255"),
        (np.full((5, 7, 3), -0.1), r"in \[0, 1\].*\[-0.1, -0.1\].*clip"),
        (np.full((5, 7, 3), 1e300), r"in \[0, 1\].*1e\+300"),
        (np.full((5, 7, 3), np.nan), r"finite.*105 NaN or infinite.*\(5, 7, 3\)"),
        (np.where(RGB > 0.99, np.inf, RGB), r"finite.*NaN or infinite"),
        (None, r"NoneType"),
        (object(), r"object"),
        ([[1.0], [1.0, 2.0]], r"is not an image"),
        ({"a": 1}, r"dict"),
        (torch.zeros(2, 2).to_sparse(), r"is not an image"),
    ],
)
def test_refused(image: object, message: str) -> None:
    with pytest.raises(ImageError, match=f"(?s)the target.*{message}") as error:
        as_target(image)
    assert isinstance(error.value, FideError) and isinstance(error.value, ValueError)


# -- files -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrap", [str, Path])
def test_a_file_is_its_pixels(tmp_path: Path, wrap: type) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(BYTES).save(path)
    np.testing.assert_array_equal(as_target(wrap(path)), BYTES / np.float32(255))


def test_a_photo_is_turned_upright(tmp_path: Path) -> None:
    image = Image.fromarray(BYTES)
    exif = image.getexif()
    exif[0x0112] = 6  # orientation: the right side is up
    image.save(tmp_path / "a.png", exif=exif)
    upright = np.rot90(BYTES, -1) / np.float32(255)
    np.testing.assert_array_equal(as_target(tmp_path / "a.png"), upright)


def test_load_reduces_large_images(tmp_path: Path) -> None:
    pixels = np.zeros((40, 80, 3), np.uint8)
    pixels[:, 40:] = 255
    Image.fromarray(pixels).save(tmp_path / "a.png")
    Image.fromarray(pixels).save(tmp_path / "a.jpg", quality=100)
    for name in ("a.png", "a.jpg"):
        small = load(tmp_path / name, max_side=8)
        assert canonical(small) and small.shape == (4, 8, 3)
        np.testing.assert_allclose(small[:, :4], 0.0, atol=0.02)
        np.testing.assert_allclose(small[:, 4:], 1.0, atol=0.02)
    assert load(tmp_path / "a.png", max_side=80).shape == (40, 80, 3)
    assert load(tmp_path / "a.png").shape == (40, 80, 3)


@pytest.mark.parametrize("side", [0, -1, 1.5, "3", True])
def test_a_largest_side_is_a_whole_number(side: Any, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="max_side must be a whole number >= 1"):
        load(tmp_path / "a.png", max_side=side)


DEEP = np.array([[0, 65535, 32768]], np.uint16)


@pytest.mark.parametrize("ending", ["png", "tif", "pgm"])
def test_16_bits_of_files(ending: str, tmp_path: Path) -> None:
    Image.fromarray(DEEP).save(tmp_path / f"a.{ending}")
    np.testing.assert_allclose(as_target(tmp_path / f"a.{ending}")[..., 1], DEEP / 65535, atol=1e-7)
    np.testing.assert_allclose(as_target(Image.fromarray(DEEP))[..., 1], DEEP / 65535, atol=1e-7)


def test_whole_numbers_of_32_bits_are_refused_as_in_an_array(tmp_path: Path) -> None:
    image = Image.fromarray(np.array([[0, 255]], np.int32))
    image.save(tmp_path / "a.tif")
    for given_image in (image, tmp_path / "a.tif"):
        with pytest.raises(ImageError, match="int32; divide by the value"):
            as_target(given_image)


@pytest.mark.parametrize("ending", ["gif", "tif", "png"])
def test_of_several_frames_the_first_is_taken(ending: str, tmp_path: Path) -> None:
    frames = [Image.new("RGB", (6, 6), color) for color in ("red", "lime", "blue")]
    frames[0].save(tmp_path / f"a.{ending}", save_all=True, append_images=frames[1:])
    image = as_target(tmp_path / f"a.{ending}")
    np.testing.assert_array_equal(image, np.broadcast_to([1, 0, 0], (6, 6, 3)))


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ImageNotFoundError, match=r"no image file at .*gone\.png") as error:
        as_target(tmp_path / "gone.png")
    assert isinstance(error.value, FileNotFoundError) and isinstance(error.value, ValueError)


def png_header(width: int, height: int) -> bytes:
    """A PNG of that size with next to no data."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        crc = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", crc)

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + data


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"", id="empty"),
        pytest.param(b"not an image", id="text"),
        pytest.param(png_header(100, 100), id="cut short"),
        pytest.param(png_header(100_000, 100_000), id="bomb"),
        pytest.param(png_header(10_000, 10_000), id="small bomb"),
        pytest.param(png_header(MAX_PIXELS // 8000 + 1, 8000), id="smallest bomb"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.png"
    path.write_bytes(content)
    with pytest.raises(ImageError, match=re.escape(path.name)):
        as_target(path)


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("ending", ["png", "tif", "ppm"])
def test_colors_of_16_bits_keep_all_of_them(ending: str, channels: int, tmp_path: Path) -> None:
    if (ending, channels) == ("ppm", 4):
        return
    colors = np.random.default_rng(0).integers(0, 65536, (4, 6, channels), np.uint16)
    order = [2, 1, 0, 3][:channels]
    cv2.imwrite(str(tmp_path / f"a.{ending}"), colors[..., order])
    made, expected = as_target(tmp_path / f"a.{ending}"), as_target(colors / 65535)
    np.testing.assert_allclose(made, expected, atol=1e-6)
    assert load(tmp_path / f"a.{ending}", max_side=3).shape == (2, 3, 3)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_colors_of_16_bits_are_upright(orientation: int, tmp_path: Path) -> None:
    colors = np.random.default_rng(0).integers(0, 65536, (4, 6, 3), np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), colors[..., ::-1])
    exif = Image.Exif()
    exif[0x0112] = orientation
    body = exif.tobytes()[6:]  # without "Exif" and two zeros
    chunk = struct.pack(">I", len(body)) + b"eXIf" + body
    chunk += struct.pack(">I", zlib.crc32(chunk[4:]))
    data = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(data[:33] + chunk + data[33:])  # behind the header
    image = Image.fromarray((colors >> 8).astype(np.uint8))
    image.getexif()[0x0112] = orientation
    turned = ImageOps.exif_transpose(image)
    np.testing.assert_allclose(
        as_target(tmp_path / "a.png"), np.asarray(turned) / 255, atol=1.1 / 255
    )


@pytest.mark.parametrize(
    ("name", "image", "words"),
    [
        ("a.hdr", np.ones((4, 4, 3)), "save it as .tif"),
        ("a.jpg", np.ones((4, 4, 4)), "jpg cannot hold"),
        ("a.png", np.full((4, 4, 3), np.nan), "save it as .tif"),
    ],
)
def test_what_a_format_cannot_hold_is_not_written(
    name: str, image: Any, words: str, tmp_path: Path
) -> None:
    with pytest.raises(ImageError, match=words):
        save(tmp_path / name, image)
    assert not (tmp_path / name).exists()
