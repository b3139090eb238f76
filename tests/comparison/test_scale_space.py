"""Coarse to fine: what decides, what is blurred, and what stays sharp."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fide_plugins import losses
from fide_plugins.comparison.scale_space import ScaleSpace, blurred, predictability
from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64
from fide_plugins.views import Views

SIDE = 32
V, U = np.mgrid[0:SIDE, 0:SIDE] / (SIDE - 1)
ANSWER = np.array([0.62, 0.4, 0.55])


def ring(x: Float64, width: float = 0.02) -> Float32:
    """A circle around (x, y) with a radius, as thin as a pixel or two."""
    r = np.hypot(U - 0.3 - 0.4 * x[0], V - 0.3 - 0.4 * x[1]) - 0.1 - 0.2 * x[2]
    return np.asarray(np.exp(-0.5 * np.square(r / width)), np.float32)


def renders(X: Float64, width: float = 0.02) -> Float32:
    return np.stack([ring(x, width) for x in X])


def made(seed: int = 0, **options: Any) -> FIDE:
    return FIDE(3, ring(ANSWER), seed=seed, **{"coarse_to_fine": True, **options})


def run(opt: FIDE, number: int, piece: int = 6) -> None:
    for _ in range(number // piece):
        X = opt.ask(piece)
        opt.tell(X, renders(X))


def test_parameters_follow_from_images_that_are_linear_in_them() -> None:
    rng = np.random.default_rng(0)
    X = rng.random((40, 4))
    assert predictability(X @ rng.standard_normal((4, 50)), X) > 0.99
    assert predictability(rng.standard_normal((40, 50)), X) < 0.1
    assert predictability(np.ones((40, 50)), X) == 0


@pytest.mark.parametrize(("width", "useful"), [(0.012, True), (0.4, False)])
def test_the_first_candidates_say_whether_blurs_are_useful(width: float, useful: bool) -> None:
    target = np.repeat(ring(ANSWER, width)[..., None], 3, axis=2)
    scales = ScaleSpace(Views.read(target), possible=True)
    for i, x in enumerate(np.random.default_rng(0).random((36, 3))):
        assert scales.useful is None
        scales.note(i, x, np.repeat(ring(x, width)[..., None], 3, axis=2))
    first = scales.decide(target, 0.5, ANSWER, None)
    assert scales.useful is useful
    assert (scales.blur > 0) is useful is (first is not None)
    assert scales.asked is useful  # features that hardly agree need patience, too


def test_the_search_is_blurred_and_the_answer_is_not() -> None:
    opt = made()
    sharp = losses.make("mse", ring(ANSWER))
    X = opt.ask(6)
    images = renders(X)
    np.testing.assert_array_equal(opt.tell(X, images), sharp(images))
    blur, target = opt.state.scales.blur, ring(ANSWER)[..., None]
    seen = [np.square(blurred(one[..., None] - target, blur)).mean() for one in images]
    sample = opt.state.search_best
    assert sample is not None and opt.best is not None
    assert sample.loss == pytest.approx(min(seen), rel=1e-4)
    assert opt.best.loss == sharp(images).min()


def test_thin_structures_are_found_coarse_first() -> None:
    opt = made()
    run(opt, 240)
    assert opt.best is not None
    assert np.abs(opt.best.x - ANSWER).max() < 0.02


def test_a_series_of_searches_ends_sharp() -> None:
    opt = made()
    blurs = [opt.state.scales.blur]
    while opt.state.scales.blur and opt.evaluations < 600:
        run(opt, 6)
        blurs.append(opt.state.scales.blur)
    assert blurs == sorted(blurs, reverse=True) and blurs[-1] == 0
    assert len(set(blurs)) == 4


def test_pieces_of_a_tell_do_not_matter() -> None:
    opts = [made(), made()]
    for _ in range(40):
        X = opts[0].ask()
        np.testing.assert_array_equal(X, opts[1].ask())
        opts[0].tell(X, renders(X))
        for x in X:
            opts[1].tell(x[None], renders(x[None]))
    assert opts[0].state.scales.blur == opts[1].state.scales.blur
    np.testing.assert_array_equal(opts[0].ask(), opts[1].ask())


@pytest.mark.parametrize("coarse", [True, None])
def test_a_saved_run_goes_on(coarse: bool | None, tmp_path: Any) -> None:
    opt = made(coarse_to_fine=coarse)
    run(opt, 24)
    opt.save(tmp_path / "run.fide")
    other = FIDE.load(tmp_path / "run.fide")
    for one in (opt, other):
        run(one, 60)
    assert other.state.scales.blur == opt.state.scales.blur
    np.testing.assert_array_equal(other.ask(6), opt.ask(6))


def test_the_losses_of_a_user_are_of_no_blur() -> None:
    opt = made()
    run(opt, 12)
    assert opt.state.scales.blur > 0
    X = opt.ask(6)
    opt.tell(X, renders(X), np.arange(6.0) + 1)
    assert opt.state.scales.blur == 0 and opt.state.scales.useful is False
    run(opt, 12)
    assert np.isfinite(opt.ask(6)).all()


def test_the_next_picture_begins_sharp() -> None:
    opt = made()
    run(opt, 12)
    opt.retarget(ring(ANSWER - 0.05))
    assert opt.state.scales.blur == 0
    run(opt, 12)


def test_views_and_masks_are_blurred() -> None:
    mask = np.ones((SIDE, SIDE))
    mask[:, :4] = 0
    both = [ring(ANSWER), ring(ANSWER, 0.05)]
    opt = FIDE(3, both, mask=[mask, None], coarse_to_fine=True, seed=0)
    assert opt.state.scales.blur > 0
    for _ in range(6):
        X = opt.ask(6)
        opt.tell(X, [renders(X), renders(X, 0.05)])
    assert opt.best is not None and opt.best.loss >= 0


@pytest.mark.parametrize(
    "options",
    [
        {"loss": lambda images: np.square(images).mean(axis=(1, 2, 3))},
        {"restarts": "none"},
        {"proposer": "none"},
        {"preset": "fast", "coarse_to_fine": False},
    ],
)
def test_where_nothing_is_blurred(options: Any) -> None:
    opt = made(**options)
    run(opt, 48)
    assert opt.state.scales.blur == 0 and opt.state.scales.useful is False


def squares(x: Float64, side: int = 48, across: int = 16) -> tuple[Float32, Float32]:
    """A board of squares at x (2,), so many across the picture, and what it covers."""
    v, u = np.mgrid[0:side, 0:side] / side
    cover = ((abs(u - x[0]) < 0.3) & (abs(v - x[1]) < 0.3)).astype(np.float32)
    black = (np.floor(across * u) + np.floor(across * v)) % 2
    return np.repeat(black[..., None], 3, axis=2).astype(np.float32), cover


@pytest.mark.parametrize(
    ("n", "across", "blurs"),
    [(1, 16, (0.0125,)), (2, 16, (0.0125,)), (1, 2, (0.08, 0.05, 0.025, 0.0125))],
)
def test_of_a_photograph_blurs_that_leave_no_contrast_are_left_out(
    n: int, across: int, blurs: tuple[float, ...]
) -> None:
    image, cover = squares(np.array([0.5, 0.5]), across=across)
    photograph = (cover * image[..., 0] + (1 - cover) * 0.3).astype(np.float32)
    target = photograph if n == 1 else [photograph, photograph]
    optimizer = FIDE(2, target, photo=True, seed=0)
    while optimizer.evaluations < 60 and optimizer.state.scales.useful is None:
        X = optimizer.ask()
        renders = [squares(x, across=across) for x in X]
        optimizer.tell(X, renders if n == 1 else [renders, renders])
    assert optimizer.state.scales.asked
    assert optimizer.state.scales.blurs == list(blurs)


def test_the_best_renders_of_another_picture_are_forgotten() -> None:
    image, cover = squares(np.array([0.5, 0.5]))
    optimizer = FIDE(2, cover * image[..., 0], photo=True, seed=0)
    for _ in range(3):
        X = optimizer.ask()
        optimizer.tell(X, [squares(x) for x in X])
    optimizer.retarget(1 - image[..., 0])
    assert optimizer.state.kept is not None and len(optimizer.state.kept) == 0
