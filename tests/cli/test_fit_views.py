"""`fide fit` with several views, and with masks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fide_plugins.errors import ImageError
from fide_plugins.fitting.one_call import prepare
from fide_plugins.fitting.stopping import Stopping

from .conftest import fide, last_line, summary

pytestmark = pytest.mark.figures


def _begin(images: Any, target: Any) -> None:
    """A fit by a renderer that always returns these."""
    rules = Stopping.of(1, None, None)
    prepare(lambda x: images, target, 2, stopping=rules, workers=0, check_first=True)


def test_views_need_one_image_each() -> None:
    target = np.zeros((8, 8, 3), np.float32)
    both = [target, target]
    for images, message in (
        (target, "must return a list of 2 images, one for each view"),
        ([*both, target], "a list of 2 images, .* not 3 images"),
        ([target, None], "render returned None for view 1; let it return"),
        ([target, target[:4]], "the first render gave no image that fits: .*4"),
    ):
        with pytest.raises(ImageError, match=message):
            _begin(images, both)
    _begin(both, both)
    _begin(tuple(both), both)


@pytest.fixture
def hidden(target: Path) -> Path:
    """``mask.png``: the left half of the target counts.  ``spoiled.png``: its right half is not."""
    mask = np.zeros((12, 16), np.uint8)
    mask[:, :8] = 255
    Image.fromarray(mask).save(target.parent / "mask.png")
    with Image.open(target) as image:
        spoiled = np.asarray(image).copy()
    spoiled[:, 8:] = 77
    Image.fromarray(spoiled).save(target.parent / "spoiled.png")
    return target


@pytest.mark.usefixtures("hidden")
def test_what_a_mask_hides_does_not_count(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--renderer", "scene.py:render", "--mask", "mask.png", "--workers", 0, "--json"]
    losses = []
    for picture in ("target.png", "spoiled.png"):
        assert fide("fit", picture, *words, "--budget", 20) == 0
        losses.append(summary(capsys)["best_loss"])
    assert losses[0] == losses[1] > 0


@pytest.mark.usefixtures("hidden")
def test_the_alpha_of_the_target_and_weights_are_masks_too(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with Image.open("target.png") as gray, Image.open("mask.png") as mask:
        image = gray.convert("RGB")
        Image.merge("RGBA", (*image.split(), mask)).save("cut.png")
        Image.composite(image, Image.new("RGB", image.size, "white"), mask).save("white.png")
    words = ["--renderer", "scene.py:render", "--workers", 0, "--budget", 20, "--json"]
    losses = []
    for picture, *given in (
        ["cut.png", "--mask", "alpha"],
        ["white.png", "--mask", "mask.png"],
        ["white.png", "--weights", "mask.png"],
    ):
        assert fide("fit", picture, *words, *given) == 0
        losses.append(summary(capsys)["best_loss"])
    assert losses == pytest.approx(losses[:1] * 3, rel=1e-6)
    assert fide("fit", "target.png", *words, "--mask", "alpha") == 2
    line = last_line(capsys)
    assert "must have an alpha channel" in line


@pytest.fixture
def views(hidden: object) -> None:
    """views.py renders two views; the second target is small.png."""
    Path("views.py").write_text(
        "from scene import render as draw, space\n"
        "def render(p):\n    return [draw(p), draw(p)[::2, ::2]]\n"
    )
    with Image.open("target.png") as image:
        Image.fromarray(np.asarray(image)[::2, ::2]).save("small.png")


@pytest.mark.usefixtures("views")
def test_several_targets_are_views_of_one_render(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--renderer", "views.py:render", "--workers", 0, "--budget", 20, "--out", "out"]
    assert fide("fit", "target.png", "small.png", *words, "--json") == 0
    assert summary(capsys)["evaluations"] == 20
    assert fide("solutions", "out") == 0


@pytest.mark.usefixtures("views")
def test_targets_and_masks_must_fit_the_views(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--renderer", "views.py:render", "--workers", 0]
    assert fide("fit", "small.png", "target.png", *words) == 2
    assert "the first render gave no image that fits" in last_line(capsys)
    assert fide("fit", "target.png", "small.png", *words, "--mask", "mask.png") == 2
    assert "a single one, which needs views of one size" in last_line(capsys)
    assert fide("fit", "target.png", "target.png", *words, *["--mask", "mask.png"] * 3) == 2
    assert "one entry for each of the 2 views" in last_line(capsys)
