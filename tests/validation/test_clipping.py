"""Renders beyond white: an overshoot is clipped and counted, another scale ends the run."""

from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins import FIDE
from fide_plugins.errors import ImageError, ValueRangeError
from fide_plugins.validation.images import as_batch, as_target
from fide_plugins.validation.tensors import as_tensor_batch

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
    with pytest.raises(ValueRangeError, match="another scale"):
        as_tensor_batch(torch.as_tensor(blob(250, width)[None]))


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
