"""Every mistake is told by value and rule, and changes nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins.errors import (
    DeviceError,
    FideError,
    ImageError,
    ImageNotFoundError,
    LossError,
    OptionError,
    PointsError,
    UnknownNameError,
)
from fide_plugins.fide import FIDE
from fide_plugins.types import Float32

from .helpers import Render, StateOf

BLACK = np.zeros((16, 16, 3), np.float32)


def with_one(value: float) -> Float32:
    image = BLACK.copy()
    image[3, 4, 1] = value
    return image


TARGETS: dict[str, tuple[Any, str]] = {
    "none": (None, "target"),
    "number": (3.0, r"target.*\(\)"),
    "one axis": (np.zeros(16), r"\(16,\)"),
    "four axes": (BLACK[None], r"\(1, 16, 16, 3\)"),
    "two channels": (np.zeros((16, 16, 2)), r"channels.*\(16, 16, 2\)"),
    "empty": (np.zeros((0, 16, 3)), r"empty.*\(0, 16, 3\)"),
    "int64": (np.zeros((16, 16, 3), np.int64), "uint8.*int64"),
    "complex": (np.zeros((16, 16, 3), complex), "complex128"),
    "strings": (np.full((16, 16, 3), "a"), "target"),
    "objects": (np.full((16, 16, 3), None), "object"),
    "NaN": (with_one(np.nan), "finite.*1 NaN"),
    "infinite": (with_one(np.inf), "finite"),
    "too bright": (BLACK + 255.0, r"\[0, 1\].*255"),
    "negative": (with_one(-0.5), r"\[0, 1\].*-0.5"),
    "ragged": ([[0.0, 1.0], [0.0]], "target"),
    "no file": ("/nowhere/at/all.png", "/nowhere/at/all.png"),
}


@pytest.mark.parametrize("what", TARGETS)
def test_wrong_targets(what: str) -> None:
    target, message = TARGETS[what]
    with pytest.raises(ImageError, match=f"(?s){message}") as caught:
        FIDE(4, target)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize("k", [0, -1, 1.5, "a", True])
def test_a_number_of_solutions_is_whole(k: Any) -> None:
    with pytest.raises(OptionError, match="k must be a whole number >= 1, not"):
        FIDE(2, BLACK).solutions(k)


def test_a_file_that_is_no_image(tmp_path: Path) -> None:
    path = tmp_path / "text.png"
    path.write_text("not an image")
    with pytest.raises(ImageError, match="text.png"):
        FIDE(4, path)
    with pytest.raises(ImageNotFoundError, match="absent.png"):
        FIDE(4, tmp_path / "absent.png")


SETTINGS: dict[str, tuple[dict[str, Any], type[Exception], str]] = {
    "dim 0": ({"dim": 0}, OptionError, "dim.*>= 1.*0"),
    "dim negative": ({"dim": -3}, OptionError, "dim.*-3"),
    "dim fraction": ({"dim": 2.5}, OptionError, r"dim.*2\.5"),
    "dim bool": ({"dim": True}, OptionError, "dim.*True"),
    "dim none": ({"dim": None}, OptionError, "dim.*None"),
    "sigma0 zero": ({"sigma0": 0}, OptionError, r"sigma0.*\(0, 1\].*0"),
    "sigma0 tiny": ({"sigma0": 5e-324}, OptionError, "sigma0.*1e-16.*5e-324"),
    "sigma0 rows": ({"sigma0": [[0.1], [0.1, 0.2]]}, OptionError, "sigma0 must be one number or"),
    "sigma0 huge": ({"sigma0": 10**400}, OptionError, "sigma0.*1000"),
    "sigma0 NaN": ({"sigma0": float("nan")}, OptionError, "sigma0.*nan"),
    "sigma0 large": ({"sigma0": 1.5}, OptionError, r"sigma0.*1\.5"),
    "sigma0 text": ({"sigma0": "wide"}, OptionError, "sigma0.*wide"),
    "sigma0 bool": ({"sigma0": True}, OptionError, "sigma0.*True"),
    "popsize": ({"popsize": 3}, OptionError, "popsize.*>= 4.*3"),
    "popsize large": ({"popsize": 10**9}, OptionError, "popsize.*1,048,576.*1,000,000,000"),
    "seed": ({"seed": -1}, OptionError, "seed.*-1"),
    "seed text": ({"seed": "one"}, OptionError, "seed.*'one'"),
    "preset": ({"preset": "best"}, UnknownNameError, "preset 'best'.*balanced"),
    "encoder": ({"encoder": "vgg"}, UnknownNameError, "encoder 'vgg'.*dense"),
    "loss": ({"loss": "l1"}, UnknownNameError, "loss 'l1'.*mse"),
    "loss number": ({"loss": 3}, LossError, "loss.*3"),
    "device": ({"device": "abacus"}, DeviceError, "abacus"),
    "option": ({"popsise": 8}, OptionError, "popsise.*popsize"),
    "epochs": ({"epochs": 2**40}, OptionError, "epochs.*10,000.*1,099,511,627,776"),
    "schedule": ({"schedule": (0.1, 0.2)}, OptionError, r"0\.1, 0\.2"),
}


@pytest.mark.parametrize("what", SETTINGS)
def test_wrong_settings(what: str) -> None:
    changes, error, message = SETTINGS[what]
    settings: dict[str, Any] = {"dim": 4, "target": BLACK} | changes
    with pytest.raises(error, match=f"(?s){message}") as caught:
        FIDE(**settings)
    assert isinstance(caught.value, FideError) and isinstance(caught.value, ValueError)


X = np.full((3, 4), 0.5)
IMAGES = np.stack([BLACK] * 3)
LOSSES = np.zeros(3)


def points(value: object) -> Any:
    changed = X.astype(object) if isinstance(value, str | None) else X.copy()
    changed[1, 2] = value
    return changed


def images(value: float) -> Float32:
    return np.stack([BLACK, with_one(value), BLACK])


TELLINGS: dict[str, tuple[tuple[Any, ...], type[Exception], str]] = {
    "another dimension": ((X[:, :3], IMAGES), PointsError, r"\(n, 4\).*\(3, 3\)"),
    "one point": ((X[0], IMAGES[:1]), PointsError, r"\(4,\).*x\[None\]"),
    "below the box": ((points(-0.1), IMAGES), PointsError, r"\[0, 1\].*X\[1, 2\] = -0.1"),
    "above the box": ((points(1.5), IMAGES), PointsError, r"X\[1, 2\] = 1.5"),
    "NaN point": ((points(np.nan), IMAGES), PointsError, r"X\[1, 2\] = nan"),
    "text": ((points("a"), IMAGES), PointsError, "real numbers"),
    "no points": ((None, IMAGES), PointsError, "real numbers"),
    "complex points": ((X + 0j, IMAGES), PointsError, "complex"),
    "ragged points": (([[0.1] * 4, [0.2]], IMAGES), PointsError, "X must"),
    "nothing": ((X,), LossError, "images, losses, or both"),
    "too few images": ((X, IMAGES[:2]), ImageError, "2 images for 3 points"),
    "too many images": ((X, [BLACK] * 4), ImageError, "4 images for 3 points"),
    "another size": ((X, np.zeros((3, 16, 17, 3))), ImageError, "16 x 16.*16 x 17"),
    "one image of another size": (
        (X, [BLACK, BLACK, BLACK[:8]]),
        ImageError,
        "image 2.*16 x 16.*8 x 16",
    ),
    "channels": ((X, np.zeros((3, 16, 16, 5))), ImageError, "channels.*5"),
    "single image": ((X[:1], BLACK), ImageError, r"image\[None\]"),
    "integers": ((X, IMAGES.astype(int)), ImageError, "uint8.*int64"),
    "NaN pixel": ((X, images(np.nan)), ImageError, "finite.*1 NaN"),
    "infinite pixel": ((X, images(np.inf)), ImageError, "finite"),
    "images are a path": ((X, "a.png"), ImageError, "a.png"),
    "too few losses": ((X, IMAGES, LOSSES[:2]), LossError, r"3 numbers.*\(2,\)"),
    "one loss for all": ((X, IMAGES, 0.5), LossError, r"3 numbers.*\(\)"),
    "matrix of losses": ((X, None, np.zeros((3, 2))), LossError, r"\(3, 2\)"),
    "text losses": ((X, None, ["a", "b", "c"]), LossError, "real numbers"),
    "complex losses": ((X, None, LOSSES + 1j), LossError, "complex"),
    "no losses": ((X, None, [None] * 3), LossError, "real numbers"),
    "wrong image with right losses": ((X, images(np.nan), LOSSES), ImageError, "finite"),
}


def in_the_middle(render: Render) -> FIDE:
    """With a queue, candidates outside, results of this generation, and an injected candidate."""
    opt = FIDE(4, BLACK, seed=0, popsize=8)
    for _ in range(3):
        X = opt.ask()
        opt.tell(X, render(X))
    X = opt.ask(5)
    opt.tell(X[:2], render(X[:2]))
    opt.tell(np.full((1, 4), 0.2), render(np.full((1, 4), 0.2)))
    return opt


@pytest.mark.parametrize("what", TELLINGS)
def test_wrong_results_change_nothing(what: str, render: Render, state_of: StateOf) -> None:
    arguments, error, message = TELLINGS[what]
    opt = in_the_middle(render)
    before, times = state_of(opt), dict(opt.times)
    with pytest.raises(error, match=f"(?s){message}") as caught:
        opt.tell(*arguments)
    assert isinstance(caught.value, FideError) and isinstance(caught.value, ValueError)
    assert state_of(opt) == before
    assert opt.times == times


@pytest.mark.parametrize("n", [0, -1, 2.5, "all", True, float("nan")])
def test_wrong_number_to_ask(n: Any, render: Render, state_of: StateOf) -> None:
    opt = in_the_middle(render)
    before = state_of(opt)
    with pytest.raises(OptionError, match="n must be a whole number >= 1"):
        opt.ask(n)
    assert state_of(opt) == before


@pytest.mark.parametrize(
    ("loss", "error", "message"),
    [
        (lambda images: images.mean(), LossError, r"3 numbers.*\(\)"),
        (lambda images: images.mean(axis=(1, 2)), LossError, r"\(3, 3\)"),
        (lambda images: None, LossError, "real numbers"),
        (lambda images: ["a"] * len(images), LossError, "real numbers"),
        (lambda images: 1 / 0, ZeroDivisionError, "zero"),
    ],
)
def test_a_loss_that_fails_changes_nothing_and_can_be_told_again(
    loss: Any, error: type[Exception], message: str, state_of: StateOf
) -> None:
    def fails_later(images: Float32) -> Any:  # not yet when it is tried, on two images
        return loss(images) if len(images) == 3 else images.mean(axis=(1, 2, 3))

    opt = FIDE(4, BLACK, seed=0, loss=fails_later, popsize=4)
    other = FIDE(4, BLACK, seed=0, popsize=4)
    opt.tell(opt.ask(1), None, [1.0])
    other.tell(other.ask(1), None, [1.0])
    X = opt.ask()
    before = state_of(opt)
    with pytest.raises(error, match=message):
        opt.tell(X, IMAGES)
    assert state_of(opt) == before
    opt.tell(X, IMAGES, LOSSES)
    other.tell(other.ask(), IMAGES, LOSSES)
    np.testing.assert_array_equal(opt.ask(), other.ask())
