"""Gauss-Newton steps between the generations: when, how many, and from what they learn."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins import encoders
from fide_plugins.options import make_options
from fide_plugins.population import TrainingSample
from fide_plugins.proposers import make_step_model
from fide_plugins.proposers.forward import GaussNewtonSteps
from fide_plugins.types import Float64

D, T, C, K = 3, 4, 5, 10
ALL = 3 * K  # steps where all of the residual is promised
STD, MEAN = np.full(D, 0.1), np.full(D, 0.5)
MIXING = np.random.default_rng(1).standard_normal((D, T * C))
TRUTH = np.full(D, 0.6)


def image_of(x: Float64) -> Tensor:
    return torch.as_tensor(((x - 0.5) @ MIXING).reshape(T, C))


TARGET = image_of(TRUTH)
UNLIKE = TARGET + torch.as_tensor(np.random.default_rng(2).standard_normal((T, C)))
"""What no parameters make: a linear model explains little of it."""


def taught(n: int = 12, least_promise: float = 0.25) -> GaussNewtonSteps:
    steps = GaussNewtonSteps(D, minimum=5, least_promise=least_promise)
    for i, x in enumerate(np.random.default_rng(0).normal(MEAN, STD, (n, D))):
        loss = float(np.square(x - TRUTH).sum())
        steps.add(TrainingSample(i, x, image_of(x), loss, i))
    return steps


def take(steps: GaussNewtonSteps, m: int = 1) -> Float64:
    rng = np.random.default_rng(7)
    z = rng.normal(MEAN, STD, (m, D))
    x = steps.propose(z, TARGET, MEAN, STD, rng)
    steps.remaining -= m
    return x


def test_there_are_as_many_as_the_model_promises() -> None:
    """It promises all of the residual of a linear scene, and less of what no parameters make."""
    for target in (TARGET, UNLIKE):
        steps = taught(least_promise=0.0)
        steps.due = True
        left = steps.left(K, target, STD)
        assert (left == ALL) == (target is TARGET)
    assert 0 < left < ALL


def test_they_come_once_after_each_generation() -> None:
    steps = taught()
    assert steps.left(K, TARGET, STD) == 0  # none is complete
    steps.due = True
    for left in range(ALL, 0, -1):
        assert steps.left(K, TARGET, STD) == left
        take(steps)
    assert steps.left(K, TARGET, STD) == 0
    steps.due = True
    assert steps.left(K, TARGET, STD) == ALL


def test_they_end_when_the_model_no_longer_promises_much() -> None:
    steps = taught()
    steps.due = True
    assert steps.left(K, TARGET, STD) == ALL
    assert steps.left(K, UNLIKE * 3, STD) == 0
    assert steps.left(K, TARGET, STD) == 0


@pytest.mark.parametrize("why", ["evaluated", "out", "an earlier step"])
def test_steps_end_at_one_that_is_not_new(why: str) -> None:
    steps = taught(12)
    steps.due = True
    assert steps.left(K, TARGET, STD) == ALL
    second = {"evaluated": steps.x[3], "out": MEAN + 0.02, "an earlier step": MEAN}[why]
    x = np.stack([MEAN, second, MEAN + 0.01])
    kept = steps.new_ones(x, lambda row: bool((row == MEAN + 0.02).all()))
    np.testing.assert_array_equal(kept, x[:1])
    steps.remaining -= 1
    assert steps.left(K, TARGET, STD) == 0


def test_a_step_of_a_linear_scene_goes_to_the_answer() -> None:
    steps = taught(40)
    steps.due = True
    assert steps.left(K, TARGET, STD) == ALL
    assert np.abs(take(steps, 5) - TRUTH).max(axis=1).min() < 1e-3


@pytest.mark.parametrize("learned", [False, True])
def test_state(learned: bool) -> None:
    first, second = taught(), GaussNewtonSteps(D, minimum=5)
    first.due = True
    if learned:
        first.left(K, TARGET, STD)
        take(first, 3)
    second.load_state_dict(first.state_dict(), {"d": D, "T": T, "C": C})
    for steps in (first, second):
        assert steps.left(K, TARGET, STD) == (ALL - 3 if learned else ALL)
    np.testing.assert_array_equal(take(first, 4), take(second, 4))
    broken = {**first.state_dict(), "remaining": -1}
    with pytest.raises(ValueError, match="remaining"):
        second.load_state_dict(broken, {"d": D, "T": T, "C": C})


@pytest.mark.parametrize(
    ("proposer", "dim", "popsize", "there"),
    [("both", 40, 15, True), ("linear", 40, 15, False), ("both", 100, 30, True),
     ("both", 101, 50, False), ("both", 80, 17, False)],
)  # fmt: skip
def test_which_searches_have_them(proposer: str, dim: int, popsize: int, there: bool) -> None:
    options = make_options("balanced", {"proposer": proposer})
    made = make_step_model(options, dim, popsize, encoders.make("dense"))
    assert (made is not None) == there
    assert make_step_model(options, dim, popsize, encoders.make("dense"), learned=True) is None


def test_they_begin_as_soon_as_enough_candidates_are_known() -> None:
    for n in (4, 5):
        steps = taught(n, least_promise=0.0)
        steps.due = True
        assert (steps.left(K, TARGET, STD) > 0) == (n >= steps.minimum)
