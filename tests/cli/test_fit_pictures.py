"""``fide fit PICTURE --model``: a picture of the user's own."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import fide_tasks

from .conftest import KEYS, fide, one_line

pytestmark = [pytest.mark.figures, pytest.mark.usefixtures("empty_folder")]


def picture(path: str, mode: str, size: tuple[int, int]) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (*size[::-1], len(mode)), np.uint8)
    Image.fromarray(pixels[..., 0] if mode == "L" else pixels).save(path)


@pytest.mark.parametrize(
    ("name", "mode", "size", "fitted"),
    [
        ("photo.jpg", "RGB", (300, 200), (32, 21)),
        ("tall.png", "RGBA", (40, 160), (8, 32)),
        ("gray.png", "L", (20, 12), (20, 12)),  # small enough as it is
    ],
)
def test_fit_takes_pictures_of_any_size(
    name: str, mode: str, size: tuple[int, int], fitted: tuple[int, int],
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    picture(name, mode, size)
    words = ["fit", name, "--optimizer", "cma", "--size", 32, "--budget", 12, "--json"]
    assert fide(*words, "--model", "voronoi", "--cells", 60) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert list(result) == [*KEYS, "params", "status"]
    assert result["task"] == "voronoi" and result["dim"] == 300
    with Image.open(f"runs/{Path(name).stem}-voronoi-cma-mse-seed0/best.png") as png:
        assert abs(png.width - fitted[0]) <= 1 and abs(png.height - fitted[1]) <= 1
    assert fide(*words, "--model", "spline", "--control-points", 4) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["dim"] == 9


def test_fit_begins_at_the_picture(capsys: pytest.CaptureFixture[str]) -> None:
    picture("photo.png", "RGB", (12, 12))
    words = ["fit", "photo.png", "--model", "voronoi", "--cells", 9, "--budget", 12]
    assert fide(*words, "--set", "sigma0=0.1", "--out", "fit") == 0
    capsys.readouterr()
    options = json.loads(Path("fit", "run.json").read_text())["settings"]["options"]
    with Image.open("photo.png") as png:
        target = np.asarray(png, np.float32) / 255
    x0 = fide_tasks.make("voronoi", target=target, cells=9).start()
    assert x0 is not None
    np.testing.assert_allclose(options["x0"], x0, atol=1e-6)
    assert options["sigma0"] == 0.1
    assert fide(*words, "--optimizer", "cma", "--start", "picture") == 2
    assert "--start picture is for the optimizer fide; cma" in one_line(capsys)
