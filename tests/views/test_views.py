"""Several views of one scene."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_adapters.image_loss import ImageReader, views_of
from fide_plugins import FIDE, losses
from fide_plugins.errors import CheckpointError, ImageError, LossError
from fide_plugins.runtime import checkpoint
from fide_plugins.types import Float32, Float64
from fide_plugins.views.views import Views

Render = Callable[[Float64], Float32]
RNG = np.random.default_rng(3)
A, B = RNG.random((20, 24, 3), np.float32), RNG.random((12, 9, 3), np.float32)


def both(render: Render) -> Callable[[Float64], list[Float32]]:
    """Two views of the disk: the whole of it, and a wide crop of another size."""

    def of(X: Float64) -> list[Float32]:
        images = render(X)
        return [images, images[:, 4:12].copy()]

    return of


def run(opt: FIDE, images_of: Callable[[Float64], object], generations: int) -> list[Float64]:
    asked = []
    for _ in range(generations):
        X = opt.ask()
        opt.tell(X, images_of(X))
        asked.append(X)
    return asked


def test_a_list_of_one_view_is_the_run_of_that_view(render: Render, target: Float32) -> None:
    alone = FIDE(6, target, seed=0, popsize=8)
    listed = FIDE(6, [target], seed=0, popsize=8)
    one, other = run(alone, render, 6), run(listed, lambda X: [render(X)], 6)
    np.testing.assert_array_equal(one, other)
    assert alone.best is not None and listed.best is not None
    assert alone.best.loss == listed.best.loss
    assert isinstance(listed.best.image, list)
    np.testing.assert_array_equal(listed.best.image[0], alone.best.image)
    np.testing.assert_array_equal(listed.target[0], alone.target)


@pytest.mark.parametrize("name", ["mse", "perceptual", "loi"])
def test_the_loss_is_the_mean_of_the_views(name: str) -> None:
    a, b = RNG.random((2, *A.shape), np.float32), RNG.random((2, *B.shape), np.float32)
    expected = (losses.make(name, A)(a) + losses.make(name, B)(b)) / 2
    opt = FIDE(3, [A, B], loss=name, seed=0)
    np.testing.assert_allclose(opt.evaluator.loss([a, b]), expected, rtol=1e-12)


@pytest.mark.parametrize("name", ["dense", "patch"])
def test_tokens_are_joined_along_T(name: str) -> None:
    a, b = RNG.random((2, 32, 40, 3), np.float32), RNG.random((2, 16, 20, 3), np.float32)
    opt = FIDE(3, [a[0], b[0]], encoder=name, seed=0)
    of_a, of_b = FIDE(3, a[0], encoder=name).encoder, FIDE(3, b[0], encoder=name).encoder
    tokens = opt.encoder([a, b]).numpy()
    first = of_a.shape(32, 40)[0]
    assert tokens.shape == (2, *opt.target_tokens.shape)
    np.testing.assert_array_equal(tokens[:, :first], of_a(a).numpy())
    np.testing.assert_array_equal(tokens[:, first:], of_b(b).numpy())
    np.testing.assert_array_equal(opt.target_tokens.numpy(), tokens[0])


@pytest.mark.parametrize("loss", [None, "perceptual"])
def test_a_checkpoint_goes_on_bit_for_bit(
    render: Render, answer: Float64, tmp_path: Path, loss: str | None
) -> None:
    of = both(render)
    targets = [image[0] for image in of(answer[None])]
    mask = np.ones((8, 16), np.float32)
    mask[:, :5] = 0.25
    opt = FIDE(6, targets, mask=[None, mask], loss=loss, seed=1, popsize=8)
    run(opt, of, 4)
    opt.tell(X := opt.ask(3), of(X))
    opt.save(tmp_path / "c")
    copy = FIDE.load(tmp_path / "c")
    for one, other in zip(run(copy, of, 4), run(opt, of, 4), strict=True):
        np.testing.assert_array_equal(one, other)
    assert copy.weights[0] is None
    np.testing.assert_array_equal(copy.weights[1], mask)
    assert copy.best is not None and opt.best is not None
    assert copy.best.loss == opt.best.loss


def test_a_callable_gets_a_list_and_is_given_again(tmp_path: Path) -> None:
    def darkest(views: list[Float32]) -> Float64:
        values = [view.mean(axis=(1, 2, 3), dtype=np.float64) for view in views]
        largest: Float64 = np.maximum(*values)
        return largest

    opt = FIDE(3, [A, B], loss=darkest, seed=0, popsize=4)
    X = opt.ask()
    images = [RNG.random((4, *target.shape), np.float32) for target in (A, B)]
    opt.tell(X, images)
    assert opt.best is not None and opt.best.loss == darkest(images).min()
    opt.save(tmp_path / "c")
    again = FIDE.load(tmp_path / "c", loss=darkest)
    np.testing.assert_array_equal(again.evaluator.loss(images), darkest(images))
    with pytest.raises(LossError, match="callable as its loss"):
        FIDE.load(tmp_path / "c").tell(X, images)


def images(n: int = 4) -> list[Any]:
    return [np.zeros((n, 20, 24, 3), np.float32), np.zeros((n, 12, 9, 3), np.float32)]


@pytest.mark.parametrize(
    ("told", "message"),
    [
        (images()[0], r"list of 2 batches \(n, H, W, C\).*20 x 24 \+ 12 x 9.*shape \(4, 20, 24"),
        (images()[:1], "list of 2 batches.*got 1 entries"),
        ([(a, b) for a, b in zip(*images(), strict=True)], r"4 entries.*list\(zip\(\*images\)\)"),
        (images()[::-1], "view 0: .*target's size, 20 x 24"),
        ([images()[0], images(3)[1]], "view 1: .*got 3 images for 4 points"),
        ([images()[0], None], "view 1: "),
        ([images()[0], images()[1] * np.nan], "view 1: .*finite"),
    ],
    ids=["array", "too few", "by candidate", "order", "count", "none", "nan"],
)
def test_wrong_images_change_nothing(told: Any, message: str) -> None:
    opt = FIDE(3, [A, B], seed=0, popsize=4)
    X = opt.ask()
    with pytest.raises(ImageError, match=f"(?s){message}"):
        opt.tell(X, told)
    assert opt.evaluations == 0 and opt.best is None
    opt.tell(X, images())
    assert opt.evaluations == 4


@pytest.mark.parametrize("broken", ["one weight too few", "another size", "no picture"])
def test_a_forged_checkpoint_is_refused(broken: str, tmp_path: Path) -> None:
    opt = FIDE(3, [A, B], mask=[None, np.eye(12, 9, dtype=np.float32)], seed=0, popsize=4)
    saved = opt.snapshot()
    if broken == "one weight too few":
        saved["settings"]["weights"] = [None]
    elif broken == "another size":
        saved["settings"]["weights"] = [None, np.ones((3, 3), np.float32)]
    else:
        saved["settings"]["target"] = [A, 7]
    checkpoint.write(tmp_path / "c", "fide", saved)
    with pytest.raises(CheckpointError, match="impossible contents"):
        FIDE.load(tmp_path / "c")


def test_the_images_of_one_candidate() -> None:
    views = Views.read([A, B])
    np.testing.assert_array_equal(ImageReader(views)([A, B])[0], views.target)
    np.testing.assert_array_equal(ImageReader(Views.read(A))(A)[0], A)
    with pytest.raises(ImageError, match="a render is a list of 2 images"):
        ImageReader(views)([A])
    with pytest.raises(LossError, match="made for one target, and there are 2 views"):
        FIDE(3, [A, B], loss=losses.make("mse", A))


def test_a_mask_needs_a_target() -> None:
    assert views_of(None, None, None) is None
    with pytest.raises(ImageError, match="belong to a target: set target="):
        views_of(None, A[..., 0], None)
