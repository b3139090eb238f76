"""Acceptance points 17 and 18: which images are taken, and that none is kept."""

from __future__ import annotations

import gc
import tracemalloc
import warnings
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from fide_adapters.nevergrad import IMAGE, ImageLoss
from fide_plugins.errors import ImageError, LossError

from .conftest import SIZE, TARGET, fide, mse, render, told

BYTES = np.round(render(np.full(6, 0.5)) * 255).astype(np.uint8)


def in_float32(image: Any) -> Any:
    return (image / np.float32(255)).astype(np.float32)


RGB = in_float32(BYTES)
WHITE = np.full((SIZE, SIZE, 1), 255, np.uint8)


def compare(tells: list[Callable[[Any, Any, Any], None]], steps: int = 16) -> None:
    """Optimizers that are told the same in different ways ask the same."""
    optimizers = [fide(popsize=4) for _ in tells]
    for _ in range(steps):
        candidates = [optimizer.ask() for optimizer in optimizers]
        for candidate in candidates:
            np.testing.assert_array_equal(candidate.value, candidates[0].value)
        image = np.round(render(candidates[0].value) * 255).astype(np.uint8)
        for tell, optimizer, candidate in zip(tells, optimizers, candidates, strict=True):
            tell(optimizer, candidate, image)
            assert candidate.loss == pytest.approx(candidates[0].loss, rel=1e-6)
    assert all(optimizer.num_images == steps for optimizer in optimizers)


@pytest.mark.parametrize("form", [lambda image: image, in_float32, Image.fromarray])
def test_point_17_ways_of_telling(form: Callable[[Any], Any]) -> None:
    def attached(optimizer: Any, candidate: Any, image: Any) -> None:
        candidate._meta[IMAGE] = form(image)
        optimizer.tell(candidate, mse(in_float32(image)))

    compare(
        [
            lambda o, c, image: o.tell(c, image),
            lambda o, c, image: o.tell(c, form(image)),
            lambda o, c, image: o.tell(c, mse(in_float32(image)), image=form(image)),
            lambda o, c, image: o.tell(c, ImageLoss(mse(in_float32(image)), form(image))),
            lambda o, c, image: o.tell(c, (mse(in_float32(image)), form(image))),
            attached,
        ]
    )


def test_point_17_what_is_no_image_changes_nothing() -> None:
    image, message = np.zeros((SIZE, SIZE, 2)), "channels"
    optimizer, other = fide(), fide()
    for one in (optimizer, other):
        told(one, 3)
    candidate, twin = optimizer.ask(), other.ask()
    marked = optimizer.ask()
    marked._meta[IMAGE] = image
    for which, loss, beside in (
        (candidate, image, None),
        (candidate, 1.0, image),
        (candidate, ImageLoss(1.0, image), None),
        (marked, 1.0, None),
    ):
        with pytest.raises(ImageError, match=message):
            optimizer.tell(which, loss, image=beside)
    assert optimizer.num_tell == 3 and candidate.loss is None and len(optimizer.archive) == 3
    optimizer.tell(candidate, render(candidate.value))
    other.tell(twin, render(twin.value))
    assert candidate.loss == twin.loss


FLAT: dict[str, Callable[[Any], Any]] = {
    "array": np.ravel,
    "gray": lambda image: image[..., 0].ravel(),
    "list": lambda image: image.ravel().tolist(),
    "torch": lambda image: torch.from_numpy(image.ravel()),
    "row": lambda image: image[0, :, 0],
    "with a loss": lambda image: (mse(image), image.ravel()),
}


@pytest.mark.parametrize("kind", FLAT)
def test_a_flat_image_is_not_so_many_objectives(kind: str) -> None:
    """Nevergrad would take its pixels for losses, and have no best candidate."""
    optimizer, other = fide(), fide()
    candidate, twin = optimizer.ask(), other.ask()
    with pytest.raises(ImageError, match=r"16 x 16.*\(H, W\) or .* all its axes"):
        optimizer.tell(candidate, FLAT[kind](render(candidate.value)))
    assert optimizer.num_tell == 0 and candidate.loss is None
    with pytest.raises(ImageError, match="numbers"):
        fide().minimize(lambda x: FLAT[kind](render(x)))
    for one, its in ((optimizer, candidate), (other, twin)):
        one.tell(its, render(its.value))
    np.testing.assert_array_equal(told(optimizer, 12), told(other, 12))


def test_a_flat_image_of_a_small_view() -> None:
    """Its values could be losses; with images beside them they are."""
    small = TARGET[:3, :4]
    optimizer = fide(target=[TARGET, small])
    values = small[..., 0].ravel()
    with pytest.raises(ImageError, match=r"16 x 16 \+ 3 x 4.*12 numbers"):
        optimizer.tell(optimizer.ask(), values)
    optimizer.tell(optimizer.ask(), values, image=[TARGET, small])
    assert optimizer.num_objectives == 12


@pytest.mark.filterwarnings("ignore::nevergrad.common.errors.BadLossWarning")  # of a worse one
@pytest.mark.parametrize("objectives", [2, 15])
def test_several_objectives_are_not_an_image(objectives: int) -> None:
    optimizer = fide()
    for _ in range(2):
        candidate = optimizer.ask()
        image = render(candidate.value)
        losses = [mse(image) + i for i in range(objectives)]
        optimizer.tell(candidate, (losses, image))
        optimizer.tell(optimizer.ask(), np.array(losses), image=image)
    assert optimizer.num_objectives == objectives and optimizer.num_images == 4


def test_point_17_contradictions() -> None:
    optimizer, without = fide(), fide(target=None)
    candidate = optimizer.ask()
    with pytest.raises(ImageError, match="once"):
        optimizer.tell(candidate, ImageLoss(1.0, RGB), image=RGB)
    with pytest.raises(ImageError, match="not with both"):
        optimizer.tell(candidate, 1.0, image=RGB, features=np.zeros((196, 5)))
    with pytest.raises(LossError, match="with a loss"):
        optimizer.tell(candidate, None, features=np.zeros((196, 5)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        candidate = without.ask()
    with pytest.raises(LossError, match=r"optimizer\.target"):
        without.tell(candidate, RGB)
    assert optimizer.num_tell == without.num_tell == 0


class Pixels(np.ndarray[Any, Any]):
    """An image that can be watched."""


def watched(image: Any) -> Any:
    return np.array(image).view(Pixels)


@pytest.mark.parametrize("door", ["image", "loss", "ImageLoss", "_meta", "callback"])
def test_point_18_the_image_is_gone_after_it_was_told(door: str) -> None:
    optimizer = fide()
    candidate = optimizer.ask()
    image = watched(render(candidate.value))
    gone = weakref.ref(image)
    match door:
        case "image":
            optimizer.tell(candidate, 1.0, image=image)
        case "loss":
            optimizer.tell(candidate, image)
        case "ImageLoss":
            optimizer.tell(candidate, ImageLoss(1.0, image))
        case "_meta":
            candidate._meta[IMAGE] = image
            optimizer.tell(candidate, 1.0)
        case "callback":
            found = [image]
            optimizer.register_callback("tell", lambda _, c, __: c._meta.update({IMAGE: found[0]}))
            optimizer.tell(candidate, 1.0)
            optimizer.remove_all_callbacks()
            del found
    assert optimizer.num_images == 1
    del image
    gc.collect()
    assert gone() is None
    assert candidate._meta == {}


@pytest.mark.parametrize("n", [80, pytest.param(5000, marks=pytest.mark.slow)])
def test_point_18_memory_is_bounded(n: int) -> None:
    """The second half needs no more than the first did; its images alone would be 200 kB each."""
    target = np.zeros((128, 128, 3), np.float32)
    optimizer = fide(
        target=target,
        popsize=40,
        options={"restarts": "none", "buffer_generations": 1, "channel_subsets": (3,)},
    )

    def tell(n: int) -> None:
        for i in range(n):
            image = np.full(target.shape, 0.1 + i % 7 / 10, np.float32)
            optimizer.tell(optimizer.ask(), 1.0 + i % 7, image=image)

    tell(60)
    tracemalloc.start()
    try:
        tell(n)
        kept, peak = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        tell(n)
        kept_then, peak_then = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept_then - kept < 8e6  # Nevergrad keeps 100 to 1,000 candidates
    assert peak_then - peak < 8e6
