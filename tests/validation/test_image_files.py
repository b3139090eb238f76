"""EXR files: what is read and written, and what is refused."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import FIDE
from fide_plugins.errors import DependencyError, ImageError
from fide_plugins.validation import image_files
from fide_plugins.validation.image_files import read_pixels
from fide_plugins.validation.images import load, save

OpenEXR = pytest.importorskip("OpenEXR", reason="needs the extra exr")
IMAGE = (np.random.default_rng(0).random((6, 9, 3)) * 3 - 1).astype(np.float32)
ALPHA = np.random.default_rng(1).random((6, 9, 1)).astype(np.float32)


def write(path: Path, channels: dict[str, Any], **header: Any) -> Path:
    known = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(known | header, channels).write(str(path))
    return path


@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_channels_of_halves_and_of_floats(kind: Any, tmp_path: Path) -> None:
    image, path = IMAGE.astype(kind), tmp_path / "a.exr"
    write(path, {"RGB": image, "Z": image[..., 0].copy()})
    np.testing.assert_array_equal(read_pixels(path, None), image)
    np.testing.assert_allclose(FIDE(2, path, value_range=(-2, 3)).target, image, atol=1e-6)
    write(path, {"Y": image[..., 1].copy()})
    np.testing.assert_array_equal(read_pixels(path, None), image[..., 1])
    write(path, {"RGB": image}, type=OpenEXR.tiledimage, tiles=OpenEXR.TileDescription())
    np.testing.assert_array_equal(read_pixels(path, None, raw=True), image)
    assert read_pixels(path, 3).shape == (2, 3, 3)


def test_colors_are_not_multiplied_by_alpha_once_they_are_read(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", {"RGBA": np.dstack([IMAGE * ALPHA, ALPHA])})
    np.testing.assert_allclose(read_pixels(path, None)[..., :3], IMAGE, rtol=1e-5)
    save(path, np.dstack([IMAGE, ALPHA]))
    stored = OpenEXR.File(str(path)).channels()["RGBA"].pixels
    np.testing.assert_allclose(stored, np.dstack([IMAGE * ALPHA, ALPHA]), rtol=1e-6)
    gray, alpha = ALPHA[..., 0] * 0.5, ALPHA[..., 0].copy()
    write(path, {"Y": gray, "A": alpha})
    assert np.allclose(read_pixels(path, None)[..., :3], 0.5)


def test_floats_are_written_without_loss(tmp_path: Path) -> None:
    for image in (IMAGE, IMAGE[..., :1], IMAGE[..., 0]):
        save(tmp_path / "a.EXR", image)
        np.testing.assert_array_equal(read_pixels(tmp_path / "a.EXR", None), image.squeeze())
    save(tmp_path / "a.exr", np.clip(IMAGE, 0, 1))
    np.testing.assert_array_equal(load(tmp_path / "a.exr"), np.clip(IMAGE, 0, 1))


def test_sizes_are_checked_before_pixels_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "a.exr", {"RGB": IMAGE})
    data = path.read_bytes()
    for corner in ((2**14, 2**14), (2**31 - 1, 0), (2**30, 2**30), (-5, -5)):
        window = np.array([0, 0, 8, 5], "<i4").tobytes()
        hostile = np.array([0, 0, *corner], "<i4").tobytes()
        assert data.count(window) == 2  # data window, display window
        path.write_bytes(data.replace(window, hostile))
        with pytest.raises(ImageError):
            read_pixels(path, None)
    many = {f"layer.{i}": np.zeros((4, 4), np.float32) for i in range(12)}
    monkeypatch.setattr(image_files, "MAX_PIXELS", 16)
    with pytest.raises(ImageError, match="240 values in all channels"):
        read_pixels(write(path, {"RGB": IMAGE[:4, :4].copy(), **many}), None)


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({"Z": IMAGE[..., 0].copy()}, "no channels R, G, B or Y in its first part, but Z"),
        ({"Y": np.ones((3, 4), np.uint32)}, "not halves or floats"),
    ],
)
def test_what_is_no_picture(channels: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=message):
        read_pixels(write(tmp_path / "a.exr", channels), None)


def test_damaged_files_are_refused_or_read(tmp_path: Path) -> None:
    path, rng = write(tmp_path / "a.exr", {"RGB": IMAGE}), np.random.default_rng(0)
    data = np.frombuffer(path.read_bytes(), np.uint8)
    refused = 0
    for number in range(200):
        damaged = data.copy()
        damaged[rng.integers(0, len(data), 4)] = rng.integers(0, 256, 4)
        path.write_bytes(damaged[: len(data) if number % 4 else rng.integers(len(data))].tobytes())
        try:
            assert read_pixels(path, None).dtype == np.float32
        except ImageError:
            refused += 1
    assert refused > 50


def test_without_the_package_its_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "a.exr", {"RGB": IMAGE})
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    for call in (lambda: read_pixels(path, None), lambda: save(path, IMAGE)):
        with pytest.raises(DependencyError, match=r"pip install OpenEXR .*extra exr"):
            call()
