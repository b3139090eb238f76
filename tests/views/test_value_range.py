"""Values of target and renders beyond [0, 1]: `value_range`."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import FIDE, Float, Space
from fide_plugins.errors import CheckpointError, ImageError, OptionError
from fide_plugins.validation.images import as_batch
from fide_plugins.validation.values import ValueRange

V, U = np.mgrid[0:16, 0:16] / 15
SPACE = Space(x=Float(0, 1), y=Float(0, 1), power=Float(0.5, 2))
RNG = np.random.default_rng(0)


def draw(p: dict[str, float]) -> Any:
    return p["power"] * np.exp(-((U - p["x"]) ** 2 + (V - p["y"]) ** 2) / 0.08)


TARGET = draw({"x": 0.6, "y": 0.4, "power": 1.0})


def field(p: dict[str, float]) -> Any:
    return 10 * draw(p) - 3


def test_it_is_a_linear_map_and_nothing_else() -> None:
    """The same run as with target and renders mapped by hand, bit for bit."""
    mapped = FIDE(SPACE, TARGET / 4, popsize=4, seed=0)
    given = FIDE(SPACE, 8 * TARGET - 2, value_range=(-2, 30), popsize=4, seed=0)
    for _ in range(4):
        X = mapped.ask()
        np.testing.assert_array_equal(given.ask(), X)
        images = np.stack([draw(SPACE.decode(x)) for x in X])
        one, other = mapped.tell(X, images / 4), given.tell(X, 8 * images - 2)
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-12)
    assert mapped.best is not None and given.best is not None
    assert mapped.best.image is not None and given.best.image is not None
    np.testing.assert_allclose(given.best.image, 32 * mapped.best.image - 2, atol=1e-5)
    np.testing.assert_allclose(given.target[..., 0], 8 * TARGET - 2, atol=1e-5)
    assert given.value_range == (-2.0, 30.0) and mapped.value_range is None


@pytest.mark.parametrize(
    "given",
    [(1, 0), (2, 2), (0, np.inf), (np.nan, 1), 5, "wide", "01", (1, 2, 3), ("0", "1"), (True, 2),
     (0, 1e-320), (1e9, 1e9 + 1e-6), (-1.7e308, 1.7e308)],
)  # fmt: skip
def test_what_is_no_range_is_refused(given: Any) -> None:
    with pytest.raises(OptionError, match="value_range must be two"):
        FIDE(3, TARGET, value_range=given)


@pytest.mark.parametrize(
    ("picture", "expected"),
    [
        (np.array([[0.0, 10.0]]), (0, 15)),
        (np.array([[0.4, 1.6]]), (0, 2.2)),
        (np.array([[-1.0, 1.0]]), (-2, 2)),
        (np.array([[100.0, 102.0]]), (99, 103)),
        (np.array([[3.0, 3.0]]), (1.5, 4.5)),  # one value
        (np.array([[-2.0, -2.0]]), (-3, -1)),
        (np.array([[0.0, 0.0]]), (0, 0.5)),
        (np.array([[0, 200]], np.uint8), (0, 300)),  # numbers, whatever their type
        (np.array([[0, 60000]], np.uint16), (0, 90000)),
    ],
)
def test_auto_is_the_target_and_half_of_its_span(picture: Any, expected: Any) -> None:
    opt = FIDE(2, picture, value_range="auto")
    assert opt.value_range == pytest.approx(expected)
    opt.tell(opt.ask(1), [picture])
    assert opt.best is not None and opt.best.loss < 1e-14 and opt.best.image is not None
    np.testing.assert_allclose(opt.best.image[..., 0], picture, rtol=1e-6, atol=1e-6)


def test_auto_does_not_look_at_what_is_hidden() -> None:
    mask = np.ones((16, 16))
    mask[:, 8:] = 0
    for wild in (np.nan, np.inf, -1e9):
        target = 10 * TARGET
        target[:, 8:] = wild
        opt = FIDE(SPACE, target, mask=mask, value_range="auto")
        seen = 10 * TARGET[:, :8]
        assert opt.value_range == pytest.approx((0, seen.max() + np.ptp(seen) / 2))
        image = 10 * TARGET
        image[:, 8:] = wild
        assert opt.tell(opt.ask(1), [image])[0] < 1e-12
    with pytest.raises(ImageError, match='value_range="auto" needs a target without NaN'):
        FIDE(SPACE, np.where(U > 0.5, np.nan, TARGET), value_range="auto")


@pytest.mark.parametrize(
    "kind", [np.uint8, np.uint16, np.int32, np.float16, np.float32, np.float64, np.bool_]
)
@pytest.mark.parametrize("channels", [None, 1, 3, 4])
def test_numbers_of_any_type_are_mapped(kind: Any, channels: int | None) -> None:
    shape = (2, 7, 5) if channels is None else (2, 7, 5, channels)
    images = RNG.integers(0, 2 if kind is np.bool_ else 100, shape).astype(kind)
    values = ValueRange(-20.0, 180.0)
    if channels == 4:  # opaque
        images[..., 3] = np.iinfo(kind).max if np.dtype(kind).kind in "iu" else 1
    batch = as_batch(images, values=values)
    colors = images[..., :3] if images.ndim == 4 else images[..., None]
    expected = np.broadcast_to((colors.astype(np.float64) + 20) / 200, (2, 7, 5, 3))
    np.testing.assert_allclose(batch, expected, atol=1e-6)
    np.testing.assert_array_equal(as_batch(list(images), values=values), batch)


def test_values_beyond_the_range() -> None:
    with pytest.raises(ImageError, match=r"in \[0, 5\], got .*give a wider value_range"):
        FIDE(SPACE, 10 * TARGET, value_range=(0, 5))
    opt = FIDE(SPACE, 10 * TARGET, value_range=(0, 10), popsize=4)
    with pytest.warns(RuntimeWarning, match=r"values in \[.*, 12\],.*clipped to \[0, 10\]"):
        opt.tell(opt.ask(1), [12 * TARGET])
    assert opt.clipped == 1


def test_it_is_saved_and_compared(tmp_path: Path) -> None:
    opt = FIDE(SPACE, 10 * TARGET, value_range="auto", popsize=4, seed=0)
    opt.tell(opt.ask(4), [field(SPACE.decode(x)) + 3 for x in np.full((4, 3), 0.3)])
    opt.save(tmp_path / "a.ckpt")
    other = FIDE.load(tmp_path / "a.ckpt")
    assert other.value_range == opt.value_range
    np.testing.assert_array_equal(other.target, opt.target)
    np.testing.assert_array_equal(other.views.target, opt.views.target)
    np.testing.assert_array_equal(other.ask(), opt.ask())
    wider = FIDE(SPACE, 10 * TARGET, value_range=(0, 20), popsize=4, seed=0)
    with pytest.raises(CheckpointError, match="another .*value_range"):
        wider.continue_from(tmp_path / "a.ckpt")


def test_the_next_picture_has_the_range_of_the_first() -> None:
    opt = FIDE(SPACE, 10 * TARGET, value_range="auto", popsize=4, seed=0)
    values = opt.value_range
    opt.retarget(8 * TARGET)
    assert opt.value_range == values
    with pytest.raises(ImageError, match=r"got values in .*give a wider value_range"):
        opt.retarget(20 * TARGET)
    np.testing.assert_allclose(opt.target[..., 0], 8 * TARGET, rtol=1e-5)
