"""Descents: where they end, what they ask, and that a run begins with them."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins import FIDE, Choice, Float, Space
from fide_plugins.population import TrainingSample
from fide_plugins.search.descents import Descents
from fide_plugins.search.mixed import Axes
from fide_plugins.search.moves import Stage
from fide_plugins.types import Float64

ANSWER = np.array([0.3, 0.62, 0.55])


def features(x: Float64) -> Float64:
    """Smooth, not linear, of three parameters."""
    return np.concatenate([x, np.sin(2 * x), [x[0] * x[1], x[1] * x[2], np.exp(x[0])]])


def rounds(descents: Descents, missing: Any = lambda x: False) -> int:
    """Run all rounds; returns how many points were asked."""
    aim, asked = torch.tensor(features(ANSWER)[None]), 0
    while descents.under_way:
        X = descents.draw()
        np.testing.assert_array_equal(X, descents.draw())  # it changes nothing
        asked += len(X)
        samples = []
        for i, x in enumerate(X):
            tokens = torch.tensor(features(x)[None])
            loss = float(((tokens - aim) ** 2).mean())
            if not missing(x):
                samples.append(TrainingSample(i, x, tokens, loss, i))
        descents.learn(samples, aim)
    return asked


def begun(n: int = 20) -> Descents:
    rng = np.random.default_rng(0)
    descents = Descents(Axes(3), np.copy)
    descents.begin([(float(np.square(x - ANSWER).sum()), x) for x in rng.random((n, 3))])
    return descents


def test_they_end_at_the_answer_of_a_smooth_scene() -> None:
    descents = begun()
    assert rounds(descents) < 150
    np.testing.assert_allclose(descents.x[0], ANSWER, atol=1e-4)
    assert (np.diff(descents.losses) >= 0).all()


def test_renders_that_fail_are_passed_over() -> None:
    descents, rng = begun(), np.random.default_rng(1)
    rounds(descents, missing=lambda x: rng.random() < 0.2)
    assert np.abs(descents.x[0] - ANSWER).max() < 0.02


def test_a_copy_goes_on_alike() -> None:
    descents = begun()
    other = Descents(Axes(3), np.copy)
    other.load_state_dict(copy.deepcopy(descents.state_dict()))
    assert rounds(descents) == rounds(other)
    np.testing.assert_array_equal(descents.x, other.x)
    with pytest.raises(ValueError, match="round"):
        other.load_state_dict({**descents.state_dict(), "round": 99})


def test_periodic_axes_are_crossed() -> None:
    layout = Space(turn=Float(0, 1, periodic=True), y=Float(0, 1), z=Float(0, 1)).layout
    descents = Descents(Axes(3, layout), np.copy)
    descents.begin([(0.0, np.array([0.999, 0.5, 0.5]))])
    assert ((descents.draw() >= 0) & (descents.draw() <= 1)).all()
    assert np.abs(descents._apart(np.array([0.99, 0, 0]), np.array([0.01, 0, 0]))[0]) < 0.03


def disk(x: Float64, kind: float = 0.0) -> tuple[Any, Any]:
    """A disk of a gray, and its coverage."""
    y, across = np.mgrid[0:24, 0:24] / 23
    apart = np.hypot(across - x[0], y - x[1]) - 0.2
    cover = np.clip(0.5 - 23 * apart, 0, 1).astype(np.float32)
    return np.full((24, 24, 3), x[2], np.float32), cover


def photograph(x: Float64 = ANSWER) -> Any:
    image, cover = disk(x)
    clutter = np.random.default_rng(3).random((6, 6, 3)).repeat(4, 0).repeat(4, 1)
    return (cover[..., None] * image + (1 - cover[..., None]) * clutter).astype(np.float32)


def test_of_a_photograph_a_run_from_a_guess_begins_with_them() -> None:
    optimizer = FIDE(3, photograph(), x0=ANSWER + 0.06, sigma0=0.05, photo=True, seed=0)
    stages = [optimizer.state.moves.stage]
    while optimizer.evaluations < 200:
        X = optimizer.ask()
        optimizer.tell(X, [disk(x) for x in X])
        stages.append(optimizer.state.moves.stage)
    assert (stages[0], stages[-1]) == (Stage.DESCENT, Stage.SEARCH)
    assert optimizer.best is not None
    assert np.abs(optimizer.best.x[:2] - ANSWER[:2]).max() < 0.02


def test_a_run_that_was_saved_among_them_goes_on(tmp_path: Any) -> None:
    optimizer = FIDE(3, photograph(), x0=ANSWER + 0.06, sigma0=0.05, photo=True, seed=0)
    for _ in range(3):
        X = optimizer.ask()
        optimizer.tell(X, [disk(x) for x in X])
    assert optimizer.state.moves.stage is Stage.DESCENT
    optimizer.save(tmp_path / "run")
    again = FIDE.load(tmp_path / "run")
    for _ in range(8):
        X, same = optimizer.ask(), again.ask()
        np.testing.assert_array_equal(X, same)
        optimizer.tell(X, [disk(x) for x in X])
        again.tell(same, [disk(x) for x in same])


@pytest.mark.parametrize(
    "options",
    [{}, {"photo": True}, {"photo": True, "x0": ANSWER}, {"x0": ANSWER, "sigma0": 0.05}],
)
def test_elsewhere_a_run_begins_with_a_search(options: dict[str, Any]) -> None:
    assert FIDE(3, photograph(), seed=0, **options).state.moves.stage is Stage.SEARCH


def test_with_losses_of_the_user_the_search_begins_at_the_guess() -> None:
    optimizer = FIDE(3, photograph(), x0=ANSWER, sigma0=0.05, photo=True, seed=0)
    X = optimizer.ask()
    optimizer.tell(X, None, np.square(X - 0.5).sum(axis=1))
    assert optimizer.state.moves.stage is Stage.SEARCH
    assert np.abs(optimizer.state.search.mean - ANSWER).max() < 0.1


def test_a_failed_render_ends_nothing() -> None:
    optimizer = FIDE(3, photograph(), x0=ANSWER + 0.06, sigma0=0.05, photo=True, seed=0)
    X = optimizer.ask()
    assert len(np.unique(X, axis=0)) == len(X)  # the guess is one of them, once
    optimizer.tell(X[:1], None, [np.nan])
    optimizer.tell(X[1:], [disk(x) for x in X[1:]])
    assert optimizer.state.moves.stage is Stage.DESCENT
    assert len(optimizer.tell(np.empty((0, 3)), [])) == 0


def test_where_all_renders_fail_a_sharp_search_follows() -> None:
    optimizer = FIDE(3, photograph(), x0=ANSWER + 0.06, sigma0=0.05, photo=True, seed=0)
    X = optimizer.ask()
    optimizer.tell(X, None, np.full(len(X), np.nan))
    assert (optimizer.state.moves.stage, optimizer.state.scales.blur) == (Stage.SEARCH, 0.0)


def test_no_blurred_loss_comes_into_the_search() -> None:
    optimizer = FIDE(3, photograph(), x0=ANSWER + 0.06, sigma0=0.05, photo=True, seed=0)
    while optimizer.state.moves.stage is Stage.DESCENT:
        X = optimizer.ask()
        own = np.vstack([X, ANSWER + 0.01])  # the last was never asked
        losses = optimizer.tell(own, [disk(x) for x in own])  # sharp ones
    assert optimizer.state.injected is not None  # what came after the last round
    assert optimizer.state.injected[1] == losses[-1]


def test_choices_take_part() -> None:
    space = Space(x=Float(0, 1), y=Float(0, 1), gray=Choice(0.1, 0.55, 0.9))
    x0 = space.encode({"x": 0.36, "y": 0.68, "gray": 0.55})
    optimizer = FIDE(space, photograph(), x0=x0, sigma0=0.05, photo=True, seed=0)
    for _ in range(12):
        X = optimizer.ask()
        params = [space.decode(x) for x in X]
        optimizer.tell(X, [disk(np.array([p["x"], p["y"], p["gray"]])) for p in params])
    assert optimizer.best is not None and optimizer.best.params is not None
    assert optimizer.best.params["gray"] == 0.55


def test_the_next_photograph_begins_with_them_at_the_last_answer() -> None:
    optimizer = FIDE(3, photograph(), x0=ANSWER + 0.06, sigma0=0.05, photo=True, seed=0)
    for frame in range(4):
        x = ANSWER + 0.04 * frame * np.array([1, -1, 0])
        if frame:
            assert optimizer.best is not None
            last = optimizer.best.x
            optimizer.retarget(photograph(x))
            assert optimizer.state.moves.stage is Stage.DESCENT
            np.testing.assert_array_equal(optimizer.ask()[0], last)
        end = optimizer.evaluations + 140
        while optimizer.evaluations < end:
            X = optimizer.ask_ready()
            optimizer.tell(X, [disk(one) for one in X])
        assert optimizer.best is not None
        assert np.abs(optimizer.best.x[:2] - x[:2]).max() < 0.02


def test_before_any_result_the_next_photograph_begins_as_the_first() -> None:
    optimizer = FIDE(3, photograph(), x0=ANSWER + 0.06, sigma0=0.05, photo=True, seed=0)
    X = optimizer.ask()
    optimizer.tell(X[:3], None, np.full(3, np.nan))
    optimizer.retarget(photograph(ANSWER - 0.02))
    assert optimizer.state.moves.stage is Stage.DESCENT
    drawn = optimizer.ask()
    np.testing.assert_array_equal(drawn[0], ANSWER + 0.06)
    np.testing.assert_allclose(drawn.std(axis=0), X.std(axis=0), rtol=0.5)


def test_hypotheses_are_among_the_starts_around_a_point() -> None:
    descents = Descents(Axes(3), np.copy)
    hypotheses = np.random.default_rng(1).random((100, 3))
    far = np.array([0.02, 0.98, 0.02])
    descents.begin_around(far, 0.03, np.random.default_rng(0), hypotheses)
    drawn = descents.draw()
    assert len(drawn) == 36
    near = np.abs(drawn - far).max(axis=1) < 0.2
    assert 0 < near.sum() < len(drawn)
    assert all((hypotheses == x).all(axis=1).any() for x in drawn[~near])
