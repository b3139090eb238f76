"""PGPE with ClipUp against the numbers of its authors' library, pgpelib."""

from __future__ import annotations

import numpy as np
import pytest

from fide_lab.baselines.evolution import PGPE
from fide_plugins.errors import OptionError
from fide_plugins.types import Float64

BOX = 4.0  # width of the box in the units of pgpelib
CENTERS = {  # of the distribution after so many generations
    1: [-0.07797400823950489, -0.041099368712359315, -0.058673302537083326, 0.10624659759212554],
    5: [-0.29441619657705, -0.4014124199253664, -0.005109274503082149, 0.4787556384289309],
    40: [0.9083097509120104, -1.022361445037495, -0.9018586572025242, 1.2581534370711125],
}
STDS = {
    1: [0.10106575726134442, 0.09998760126703127, 0.09942769039040518, 0.10089668276647065],
    5: [0.10269836120435093, 0.09881912491147972, 0.09973218529112672, 0.1018488794324596],
    40: [0.09158811843651282, 0.0816849448103819, 0.09828137201160916, 0.0904762738021507],
}


def objective(Y: Float64) -> Float64:
    """Losses (n,) of points (n, 4) in the units of pgpelib: a bowl with ripples."""
    bowl = (Y - [0.8, -1.2, 0.3, 2.0]) ** 2 @ [1.0, 4.0, 0.2, 1.0]
    losses: Float64 = bowl + np.cos(3 * Y).sum(axis=1)
    return losses


def test_center_and_standard_deviations_are_those_of_pgpelib() -> None:
    # pgpelib at its commit of 2020: PGPE(solution_length=4, popsize=6, optimizer="clipup",
    # optimizer_config={"max_speed": 0.15, "momentum": 0.9}, dtype="float64", seed=3)
    opt = PGPE(4, popsize=6, seed=0)
    opt._rng = np.random.RandomState(3)  # type: ignore[assignment]  # its generator
    for generation in range(1, 41):
        X = opt.ask()
        opt.tell(X, losses=objective((X - 0.5) * BOX))
        if generation in CENTERS:
            center, std = (opt.recommend() - 0.5) * BOX, opt._std * BOX
            np.testing.assert_allclose(center, CENTERS[generation], rtol=1e-9)
            np.testing.assert_allclose(std, STDS[generation], rtol=1e-9)


def test_samples_are_mirrored_about_the_center() -> None:
    opt = PGPE(3, popsize=8, seed=1)
    X = opt.ask()
    np.testing.assert_allclose(X[::2] + X[1::2], 1.0)


def test_the_center_never_moves_faster_than_its_bound_nor_leaves_the_box() -> None:
    opt = PGPE(2, popsize=10, seed=2, max_speed=0.02)
    before = opt.recommend()
    for _ in range(60):
        X = opt.ask()
        opt.tell(X, losses=X.sum(axis=1))  # to a corner of the box
        after = opt.recommend()
        assert np.linalg.norm(after - before) <= 0.02 + 1e-12
        assert (after >= 0).all()
        before = after
    assert before.max() < 0.05


def test_equal_losses_move_nothing_far() -> None:
    opt = PGPE(3, popsize=10, seed=0)
    X = opt.ask()
    opt.tell(X, losses=np.full(10, np.inf))
    assert np.isfinite(opt.recommend()).all() and (np.abs(opt.recommend() - 0.5) <= 0.0376).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"popsize": 7}, "popsize must be even"),
        ({"rate": 0}, "rate must be a positive number"),
        ({"max_speed": -1}, "max_speed must be a positive number"),
        ({"momentum": 2}, r"momentum must lie in \[0, 1\]"),
        ({"std_rate": 0}, "std_rate must be a positive number"),
    ],
)
def test_options_out_of_range(options: dict[str, float], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        PGPE(3, **options)
