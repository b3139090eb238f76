"""Renders beyond white: an overshoot is clipped and counted, another scale ends the run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from fide_plugins import FIDE, Float, Space, fit
from fide_plugins.errors import (
    OptionError,
    ValueRangeError,
)
from fide_plugins.validation import images

V, U = np.mgrid[0:24, 0:24] / 23
TARGET = np.exp(-((U - 0.5) ** 2 + (V - 0.5) ** 2) / 0.02)


def blob(height: float, width: float, at: float = 0.5) -> Any:
    """Gray picture, black but for a blob."""
    return height * np.exp(-((U - at) ** 2 + (V - at) ** 2) / width**2)


def told(opt: FIDE, image: Any) -> None:
    opt.tell(opt.ask(1), [image])


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor], ids=["array", "tensor"])
@pytest.mark.parametrize("width", [0.02, 0.1, 0.5])
def test_floats_of_0_to_255_are_refused_whatever_they_show(width: float, kind: Any) -> None:
    opt = FIDE(3, TARGET, popsize=4, seed=0)
    dark = blob(0.7, width)
    told(opt, dark)  # nothing shows yet
    before = opt.evaluations
    with pytest.raises(ValueRangeError, match=r"another scale.*value_range=\(low, high\)"):
        told(opt, kind(blob(250, width)))
    assert opt.evaluations == before and opt.clipped == 0


def test_a_run_remembers_what_its_images_showed() -> None:
    """Images that are taken for an overshoot one by one, and are none together."""
    opt = FIDE(3, TARGET, popsize=4, seed=0)
    with pytest.warns(RuntimeWarning, match="are clipped") as warned:
        told(opt, blob(12, 0.3))
        told(opt, blob(12, 0.3))
    assert len(warned) == 1 and opt.clipped == 2 and opt.evaluations == 2
    loaded = FIDE.restore(opt.snapshot())
    for one in (opt, loaded):
        assert one.clipped == 2
        with pytest.raises(ValueRangeError, match="the 3 images that go beyond white"):
            told(one, blob(250, 0.3))
        assert one.clipped == 2 and one.evaluations == 2


@pytest.mark.parametrize(
    "image",
    [
        TARGET * 1.05,  # ringing
        np.where(V > 0.9, 3.0, 0.3),  # a highlight
        np.where((V == 0) & (U == 0), 1e4, 0.3 * TARGET),  # a firefly
        np.where(V > 0.9, 120.0, 0.3),  # a lamp in the picture
        TARGET * 4,  # overexposed
        TARGET - 0.1,
    ],
)
def test_an_overshoot_is_clipped_and_counted(image: Any) -> None:
    opt = FIDE(3, TARGET, popsize=4, seed=0)
    with pytest.warns(RuntimeWarning, match="clipped") as warned:
        for _ in range(20):
            told(opt, image)
    told(opt, TARGET)
    assert len(warned) == 1 and opt.clipped == 20
    assert opt.best is not None and opt.best.image is not None
    assert opt.best.image.min() >= 0 and opt.best.image.max() <= 1


# -- messages --------------------------------------------------------------------------------------


SPACE = Space(x=Float(0, 1), y=Float(0, 1), r=Float(0.05, 0.4))
PICTURE = np.linspace(0, 1, 64).reshape(8, 8)


def render(params: dict[str, float]) -> Any:
    return PICTURE * params["x"]


def tried(render: Any = render, target: Any = PICTURE, space: Any = SPACE, **options: Any) -> Any:
    return fit(render, target, space, **{"budget": 5, "workers": 0, "seed": 0, **options})


def test_a_tiff_of_floats_is_read_in_gray_and_in_colors(tmp_path: Path) -> None:
    path = tmp_path / "b.tiff"
    assert cv2.imwrite(str(path), np.full((8, 8), 0.3, np.float32))
    np.testing.assert_array_equal(images.load(path), np.full((8, 8, 3), 0.3, np.float32))
    colors = np.random.default_rng(0).random((8, 6, 3), np.float32)
    assert cv2.imwrite(str(path), colors[..., ::-1])
    np.testing.assert_array_equal(images.load(path), colors)


def keywords(x: float, y: float, r: float) -> Any:
    return PICTURE * x


@pytest.mark.parametrize("wrong", [keywords, lambda: PICTURE, lambda *, x: PICTURE])
def test_a_function_of_other_arguments_is_refused_before_it_is_called(wrong: Any) -> None:
    with pytest.raises(OptionError, match=r"one dictionary, and render\(.*lambda p: render\(\*\*p"):
        tried(wrong)
    with pytest.raises(OptionError, match=r"one array, .*; lambda x: render\(\*x\) adapts it"):
        tried(wrong, space=3)
