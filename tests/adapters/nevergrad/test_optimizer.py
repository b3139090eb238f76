"""Acceptance point 23: `minimize`, its executors, results of every kind, late ones, penalties."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from fide_adapters.nevergrad import ImageLoss
from fide_plugins.errors import ImageError
from fide_plugins.fide import FIDE

from .conftest import TARGET, fide, mse, objective, render

RESULTS: dict[str, Any] = {
    "ImageLoss": objective,
    "image": render,
    "pair": lambda x: (mse(render(x)), render(x)),
    "loss and None": lambda x: (mse(render(x)), None),
    "float": lambda x: mse(render(x)),
    "numpy": lambda x: np.float32(mse(render(x))),
    "a list of one": lambda x: [mse(render(x))],
}


@pytest.mark.filterwarnings("ignore::fide_adapters.nevergrad.NoImagesWarning")
@pytest.mark.parametrize("kind", RESULTS)
def test_point_23_results(kind: str) -> None:
    optimizer = fide(budget=30)
    best = optimizer.minimize(RESULTS[kind])
    assert optimizer.num_objectives == 1
    assert optimizer.num_images == (30 if kind in ("ImageLoss", "image", "pair") else 0)
    assert best.loss == pytest.approx(mse(render(best.value)), rel=1e-6)


def test_point_23_late_and_unknown_points_count_as_in_fide() -> None:
    """Out of order, over generations, some never asked, some twice: as FIDE alone counts them.

    Without steps, with which the search comes to where Nevergrad's rounding of 1e-9 decides.
    """
    optimizer = fide(popsize=8, preset="fast")
    alone = FIDE(6, TARGET, popsize=8, preset="fast", seed=0)
    rng = np.random.default_rng(3)
    pending: list[tuple[int, Any, Any]] = []
    delays = []
    for step in range(120):
        while len(pending) < 12:
            candidate, X = optimizer.ask(), alone.ask(1)
            np.testing.assert_allclose(candidate.value, X[0], atol=1e-9)
            pending.append((step, candidate, X))
        asked, candidate, X = pending.pop(int(rng.integers(len(pending))))
        delays.append(step - asked)
        if step % 20 == 7:  # a guess of the user
            x = rng.random(6)
            guess = optimizer.parametrization.spawn_child(new_value=x)
            optimizer.tell(guess, render(x))
            alone.tell(x[None], [render(x)])
        for _ in range(1 + (step % 20 == 11)):
            optimizer.tell(candidate, render(candidate.value))
            alone.tell(X, [render(X[0])])
    assert max(delays) > 16  # late, by more than a generation
    assert optimizer.fide.evaluations == alone.evaluations == 132


def test_point_23_a_suggestion_is_asked_and_injected() -> None:
    optimizer, alone = fide(popsize=8), FIDE(6, TARGET, popsize=8, seed=0)
    x = np.full(6, 0.4)
    optimizer.suggest(x)
    first = optimizer.ask()
    np.testing.assert_array_equal(first.value, x)
    optimizer.tell(first, render(x))
    alone.tell(x[None], [render(x)])
    for _ in range(12):
        candidate, X = optimizer.ask(), alone.ask(1)
        np.testing.assert_allclose(candidate.value, X[0], atol=1e-9)
        optimizer.tell(candidate, render(X[0]))
        alone.tell(X, [render(X[0])])


def test_point_23_penalties_rank_and_leave_the_loss_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[float] = []
    tell = FIDE.tell

    def spy(self: FIDE, X: Any, images: Any = None, losses: Any = None, **more: Any) -> None:
        reported.append(losses[0])
        tell(self, X, images, losses, **more)

    monkeypatch.setattr(FIDE, "tell", spy)
    optimizer, twin = fide(popsize=8), fide(popsize=8)
    for i in range(8):
        candidate, other = optimizer.ask(), twin.ask()
        image = render(candidate.value)
        broken = i < 4
        optimizer.tell(candidate, image, [10.0 if broken else 0.0])
        assert candidate.loss == pytest.approx(mse(image), rel=1e-12)
        penalized = reported[-1]
        assert (penalized > candidate.loss) == broken
        twin.tell(other, penalized, image=image)
    for _ in range(8):
        np.testing.assert_allclose(optimizer.ask().value, twin.ask().value, atol=1e-9)


def test_point_23_what_is_recommended_breaks_no_constraint() -> None:
    """The disk must be on the left, where the target's is not."""
    optimizer = fide(budget=130)
    best = optimizer.minimize(objective, constraint_violation=[lambda x: max(0.0, x[0] - 0.4)])
    assert best.value[0] <= 0.4
    assert best.value[0] > 0.3


@pytest.mark.filterwarnings("ignore::nevergrad.common.errors.NevergradWarning")
@pytest.mark.parametrize("loss", [math.nan, math.inf, -math.inf, 1e300])
def test_point_23_failures_rank_last_and_teach_nothing(loss: float) -> None:
    """As if their images had not been told."""
    optimizer, without = fide(popsize=8), fide(popsize=8)
    for i in range(40):
        candidate, other = optimizer.ask(), without.ask()
        np.testing.assert_array_equal(candidate.value, other.value)
        image = render(candidate.value)
        result = ImageLoss(loss if i % 2 else mse(image), image)
        optimizer.tell(candidate, result)
        without.tell(other, loss if i % 2 else result)
    assert optimizer.fide.not_finite == 20 and optimizer.fide.best.loss < 1.0
    for _ in range(50):
        assert np.isfinite(optimizer.ask().value).all()


def test_another_target_keeps_the_mask() -> None:
    mask = np.zeros(TARGET.shape[:2], np.float32)
    mask[4:] = 1
    optimizer = fide(mask=mask)
    optimizer.target = 1 - TARGET
    optimizer.ask()
    np.testing.assert_array_equal(optimizer.target, 1 - TARGET)
    np.testing.assert_array_equal(optimizer.fide.weights, mask)
    with pytest.raises(ImageError, match="size"):
        fide(mask=mask).target = np.zeros((8, 8, 3))
