"""Renders beyond white: an overshoot is clipped and counted, another scale ends the run."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from fide_plugins import FIDE, Float, Int, Space, fit
from fide_plugins.errors import (
    DeviceError,
    FideError,
    ImageError,
    OptionError,
    PointsError,
    ValueRangeError,
)
from fide_plugins.validation import images
from fide_plugins.validation.images import as_batch, as_target

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


def test_images_of_one_batch_are_counted_one_by_one() -> None:
    opt = FIDE(3, TARGET, popsize=4, seed=0)
    images = np.stack([TARGET, TARGET * 1.2, TARGET, TARGET * 1.1])
    with pytest.warns(RuntimeWarning, match="clipped"):
        opt.tell(opt.ask(4), images)
    assert opt.clipped == 2


@pytest.mark.parametrize("kind", [np.uint16, np.int64])
def test_a_type_without_a_scale_is_one_of_the_run(kind: Any) -> None:
    opt = FIDE(3, TARGET, popsize=4, seed=0)
    with pytest.raises(ValueRangeError, match="image / 65535, or give value_range"):
        told(opt, (TARGET * 60000).astype(kind))


def test_the_message_names_255_for_whole_numbers_only() -> None:
    with pytest.raises(ImageError, match=r"divide by 255, target and renders alike, or .*\(0, 255"):
        as_target(np.round(TARGET * 255))
    with pytest.raises(ImageError, match=r"value_range=\(0, 10\) or \"auto\".*same number$") as hdr:
        as_target(TARGET / TARGET.max() * 10)
    assert "255" not in str(hdr.value)
    with pytest.raises(ImageError, match="divide them by the largest$"):
        as_target(TARGET * 10, what="mask")


def test_a_canonical_batch_is_not_copied() -> None:
    batch = np.random.default_rng(0).random((3, 8, 8, 3), np.float32)
    assert as_batch(batch, (8, 8)) is batch


# -- messages --------------------------------------------------------------------------------------


SPACE = Space(x=Float(0, 1), y=Float(0, 1), r=Float(0.05, 0.4))
THREE: Any = 3.0
HALF: Any = 0.5
HUGE: Any = 1e300
PICTURE = np.linspace(0, 1, 64).reshape(8, 8)


def render(params: dict[str, float]) -> Any:
    return PICTURE * params["x"]


def tried(render: Any = render, target: Any = PICTURE, space: Any = SPACE, **options: Any) -> Any:
    return fit(render, target, space, **{"budget": 5, "workers": 0, "seed": 0, **options})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Int(THREE, 5), r"not 3\.0; write 3$"),
        (lambda: Int(HALF, 5), r"not 0\.5; use Float for real numbers"),
        (lambda: Int(HUGE, 5), "use Float for real numbers"),
        (lambda: tried(budget=20.0), r"budget must be a whole number >= 1, not 20\.0; write 20$"),
        (lambda: tried(budget=2.5), r"not 2\.5$"),
        (lambda: tried(budget=-2.0), r"not -2\.0$"),
        (lambda: tried(budget=np.inf), "not inf$"),
        (lambda: SPACE.decode([0, 1]), "^x must have 3 numbers, not 2$"),
        (lambda: SPACE.decode(np.zeros((2, 3))), r"^x must have 3 numbers, not the shape \(2, 3\)"),
        (lambda: SPACE.decode(0.5), "^x must have 3 numbers, not one number"),
        (lambda: SPACE.decode([0, 1, 2]), "must lie in"),
        (lambda: SPACE.decode([[0], [1, 2], 0]), r"^X must be an array of shape \(n, 3\): "),
        (lambda: tried(x0=[0.5, 0.5]), "it must have 3 numbers, not 2; to give values, pass a"),
        (lambda: tried(x0=0.5), "must have 3 numbers, not one number; to give values, pass a"),
        (lambda: tried(mask="alpha"), r"an alpha channel.*; or give a mask of its own, mask=ARRAY"),
        (lambda: fit(PICTURE, render, SPACE), r"^render must be a function of the parameters, not "  # type: ignore[arg-type]
         r"an array of shape \(8, 8\); the order is fit\(render, target, space\)$"),
        (lambda: fit("a.png", PICTURE, SPACE), "not 'a.png'; the order is"),  # type: ignore[arg-type]
        (lambda: tried(budgt=3), r"^fit has no option 'budgt' \(did you mean 'budget'\?\); its own:"
         " render, target, space, budget,.*; of FIDE, those that matter most: loss"),
        (lambda: tried(pop_size=8), r"did you mean 'popsize'"),
        (lambda: tried(weight=PICTURE), r"did you mean 'weights'"),
        (lambda: Space.from_toml('[a]\ntype = "int"\nlow = 0\nhihg = 1'), "unknown key of an int"),
    ],
)  # fmt: skip
def test_the_remedy_is_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(FideError, match=message):
        call()


@pytest.mark.parametrize("name", ["gpu", "GPU", "nvidia"])
def test_the_device_that_people_call_gpu_is_cuda(name: str) -> None:
    with pytest.raises(DeviceError) as error:
        FIDE(3, PICTURE, device=name)
    assert str(error.value) == f"no device '{name}' here (write 'cuda'); 'auto' or 'cpu' works"


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("b.hdr", "no size; is it whole.*HDR and EXR can"),
        ("b.EXR", "b.EXR' as an image: .*; is it whole"),
    ],
)
def test_a_file_that_is_no_picture_names_the_remedy(name: str, remedy: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"#?RADIANCE\n")
    with pytest.raises(FideError, match=remedy):
        images.load(tmp_path / name)


def test_a_file_that_is_damaged_is_not_said_to_be_of_another_format(tmp_path: Path) -> None:
    (tmp_path / "b.png").write_bytes(b"\x89PNG")
    with pytest.raises(FideError, match="as an image: .*; is it whole, and is it .* can be read$"):
        images.load(tmp_path / "b.png")


def test_a_tiff_of_floats_is_read_in_gray_and_in_colors(tmp_path: Path) -> None:
    path = tmp_path / "b.tiff"
    assert cv2.imwrite(str(path), np.full((8, 8), 0.3, np.float32))
    np.testing.assert_array_equal(images.load(path), np.full((8, 8, 3), 0.3, np.float32))
    colors = np.random.default_rng(0).random((8, 6, 3), np.float32)
    assert cv2.imwrite(str(path), colors[..., ::-1])
    np.testing.assert_array_equal(images.load(path), colors)


@pytest.mark.parametrize("name", ["mask", "weights"])
def test_a_masked_mask_is_not_told_to_be_a_mask(name: str) -> None:
    options: dict[str, Any] = {name: np.ma.masked_less(PICTURE, 0.1)}
    with pytest.raises(ImageError, match=r"masked values.*; give image\.filled\(value\)$"):
        FIDE(3, PICTURE, **options)


def keywords(x: float, y: float, r: float) -> Any:
    return PICTURE * x


@pytest.mark.parametrize("wrong", [keywords, lambda: PICTURE, lambda *, x: PICTURE])
def test_a_function_of_other_arguments_is_refused_before_it_is_called(wrong: Any) -> None:
    with pytest.raises(OptionError, match=r"one dictionary, and render\(.*lambda p: render\(\*\*p"):
        tried(wrong)
    with pytest.raises(OptionError, match=r"one array, .*; lambda x: render\(\*x\) adapts it"):
        tried(wrong, space=3)


def test_functions_that_take_one_argument_are_not_refused() -> None:
    @functools.wraps(keywords)
    def adapted(params: dict[str, float]) -> Any:
        return keywords(**params)

    class Scene:
        def __call__(self, params: dict[str, float], samples: int = 1) -> Any:
            return keywords(**params)

    for good in (adapted, Scene(), lambda *all: keywords(**all[0]), lambda p: keywords(**p)):
        assert tried(good).evaluations == 5


def test_a_second_fit_in_a_directory_is_told_how_python_resumes(tmp_path: Path) -> None:
    tried(out=tmp_path / "a")
    with pytest.raises(FideError, match=r"resume it \(resume=True\), or name another"):
        tried(out=tmp_path / "a")
    assert tried(out=tmp_path / "a", resume=True, budget=7).evaluations == 7


def test_a_point_is_a_copy() -> None:
    x = np.full(3, 0.5)
    assert not np.shares_memory(FIDE(SPACE, PICTURE, x0=x).x0, x)


def test_a_point_of_another_space_is_no_point_to_snap() -> None:
    with pytest.raises(PointsError):
        SPACE.snap(np.zeros(2))
