"""EXR files: what is read, and what is refused."""

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

OpenEXR = pytest.importorskip("OpenEXR", reason="needs the extra exr")
IMAGE = (np.random.default_rng(0).random((6, 9, 3)) * 3 - 1).astype(np.float32)
ALPHA = np.random.default_rng(1).random((6, 9, 1)).astype(np.float32)


def write(path: Path, channels: dict[str, Any]) -> Path:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(path))
    return path


@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_channels_of_halves_and_of_floats(kind: Any, tmp_path: Path) -> None:
    image, path = IMAGE.astype(kind), tmp_path / "a.EXR"
    write(path, {"RGB": image, "Z": image[..., 0].copy()})
    np.testing.assert_array_equal(read_pixels(path, None), image)
    np.testing.assert_allclose(FIDE(2, path, value_range=(-2, 3)).target, image, atol=1e-6)
    write(path, {"Y": image[..., 1].copy()})
    np.testing.assert_array_equal(read_pixels(path, None), image[..., 1])
    assert read_pixels(path, 3).shape == (2, 3)


def test_colors_are_not_multiplied_by_alpha_once_they_are_read(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", {"RGBA": np.dstack([IMAGE * ALPHA, ALPHA])})
    np.testing.assert_allclose(read_pixels(path, None)[..., :3], IMAGE, rtol=1e-5)


def test_channels_of_several_types(tmp_path: Path) -> None:
    halves = IMAGE.astype(np.float16)
    colors = {name: np.ascontiguousarray(halves[..., i]) for i, name in enumerate("RGB")}
    path = write(tmp_path / "a.exr", {**colors, "A": np.ones_like(IMAGE[..., 0])})
    np.testing.assert_array_equal(read_pixels(path, None)[..., :3], halves)


def test_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ImageError, match=r"no channels R, G, B or Y.*Z: give the array"):
        read_pixels(write(tmp_path / "a.exr", {"Z": IMAGE[..., 0].copy()}), None)
    (tmp_path / "b.exr").write_bytes(b"no picture")
    with pytest.raises(ImageError, match="is it whole"):
        read_pixels(tmp_path / "b.exr", None)
    path = write(tmp_path / "c.exr", {"RGB": IMAGE})
    with monkeypatch.context() as patch:
        patch.setattr(image_files, "MAX_PIXELS", 20)
        with pytest.raises(ImageError, match="9 x 6 pixels, more than 20"):
            read_pixels(path, None)
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(DependencyError, match=r"pip install OpenEXR .*extra exr"):
        read_pixels(path, None)
