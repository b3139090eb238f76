"""DFO-LS: its solver's own points, a missing package, least squares."""

from __future__ import annotations

import sys
from typing import Any

import dfols
import numpy as np
import pytest

from fide_lab.baselines.libraries import DFOLS
from fide_plugins import encoders
from fide_plugins.errors import DependencyError, OptionError
from fide_plugins.types import Float32, Float64

DIM = 4


def picture(X: Float64) -> Float32:
    """Images (n, 16, 16, 3) that change smoothly, and not linearly, with the parameters."""
    waves = np.random.default_rng(3).random((DIM, 16 * 16 * 3))
    images: Float32 = (0.5 + 0.4 * np.sin(X @ waves)).astype(np.float32).reshape(-1, 16, 16, 3)
    return images


TARGET = picture(np.array([[0.3, 0.6, 0.4, 0.7]]))[0]


def residuals(x: Float64) -> Float64:
    encode = encoders.make("dense")
    seen, wanted = (encode(images)[0, :, :3].numpy() for images in (picture(x[None]), TARGET[None]))
    difference = (seen.astype(np.float64) - wanted).ravel()
    scaled: Float64 = difference / np.sqrt(len(difference))
    return scaled


def test_it_is_the_solver_itself_to_the_last_bit() -> None:
    points = []

    def function(x: Float64) -> Float64:
        points.append(x.copy())
        return residuals(x)

    x0 = np.clip(0.5 + 1 / 6 * np.random.default_rng(7).standard_normal(DIM), 0.0, 1.0)
    users: Any = np.random.get_state()
    np.random.set_state(
        np.random.RandomState(np.random.MT19937(np.random.SeedSequence(7))).get_state()
    )
    try:
        dfols.solve(
            function,
            x0,
            bounds=(np.zeros(DIM), np.ones(DIM)),
            rhobeg=0.1,
            maxfun=60,
            objfun_has_noise=True,
            user_params={"restarts.use_restarts": True},
            do_logging=False,
        )
    finally:
        np.random.set_state(users)
    ours = DFOLS(DIM, TARGET, seed=7)
    for point in points:
        X = ours.ask()
        np.testing.assert_array_equal(X[0], np.clip(point, 0.0, 1.0))
        ours.tell(X, picture(X))
    assert len(points) > 3 * DIM


def test_a_smooth_problem_is_solved_in_few_renders() -> None:
    opt = DFOLS(DIM, TARGET, seed=0)
    while opt.evaluations < 60:
        X = opt.ask()
        opt.tell(X, picture(X))
    assert opt.best is not None and opt.best.loss < 1e-10


def test_the_loss_plays_no_part_in_the_search_and_chooses_the_best() -> None:
    one, other = DFOLS(DIM, TARGET, seed=0), DFOLS(DIM, TARGET, seed=0)
    for i in range(30):
        X, Y = one.ask(), other.ask()
        np.testing.assert_array_equal(X, Y)
        one.tell(X, picture(X))
        other.tell(Y, picture(Y), [float(abs(i - 11))])
    assert other.best is not None and other.best.evaluation == 11


def test_a_search_that_has_converged_is_followed_by_another() -> None:
    opt = DFOLS(DIM, TARGET, seed=0, noisy=False, soft_restarts=False)
    while opt.starts < 2:
        X = opt.ask()
        opt.tell(X, picture(X))
        assert opt.evaluations < 200
    while opt.starts < 3:
        X = opt.ask()
        opt.tell(X, picture(X))
        assert opt.evaluations < 400


def test_without_the_package_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "dfols", None)
    with pytest.raises(DependencyError, match=r"pip install DFO-LS .*extra dfols"):
        DFOLS(DIM, TARGET)


@pytest.mark.parametrize(
    "options", [{"radius": 0.6}, {"radius": True}, {"noisy": 1}, {"soft_restarts": "no"}], ids=str
)
def test_options_out_of_range_are_named(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=next(iter(options))):
        DFOLS(DIM, TARGET, **options)
