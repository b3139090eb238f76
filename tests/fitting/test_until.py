"""A fit ends when it is solved, or when noise of the target leaves nothing to be found."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fide_plugins import Float, Space, fit
from fide_plugins.fitting.stopping import Stopping
from fide_plugins.types import Float64

V, U = np.mgrid[0:48, 0:48] / 47
DISK = {"x": Float(0, 1), "y": Float(0, 1), "r": Float(0.05, 0.4)}
SPACE = Space(**DISK)
TRUTH = {"x": 0.7, "y": 0.35, "r": 0.2}
HERE: dict[str, Any] = {"workers": 0, "seed": 0}


def draw(p: Mapping[str, float]) -> Float64:
    """A soft disk (48, 48) on gray."""
    distance = np.hypot(U - p["x"], V - p["y"]) - p["r"]
    return np.asarray(0.1 + 0.8 / (1 + np.exp(30 * distance)), np.float64)


def test_a_fit_ends_within_a_generation_when_it_is_solved() -> None:
    for seed in range(3):
        result = fit(draw, draw(TRUTH), SPACE, budget=3000, workers=0, seed=seed)
        assert result.best is not None and result.optimizer is not None
        assert (result.stopped, result.status.code) == ("solved", "solved")
        assert result.evaluations <= result.best.evaluation + 1 + result.optimizer.popsize < 1000
        assert result.params == pytest.approx(TRUTH, abs=0.01)


def test_a_solved_fit_goes_on_until_the_budget_if_told(tmp_path: Path) -> None:
    solved = fit(draw, draw(TRUTH), SPACE, budget=600, out=tmp_path, **HERE)
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["stopped"] == solved.stopped == "solved" and run["limits"]["until"] == "solved"
    n = solved.evaluations
    same = fit(draw, draw(TRUTH), SPACE, budget=600, out=tmp_path, resume=True, **HERE)
    assert same.evaluations == n and same.stopped == "solved"
    more: dict[str, Any] = {"budget": n + 60, "until": "budget"}
    on = fit(draw, draw(TRUTH), SPACE, **more, out=tmp_path, resume=True, **HERE)
    assert (on.evaluations, on.stopped) == (n + 60, "budget")
    assert json.loads((tmp_path / "run.json").read_text())["stopped"] == "budget"
    whole = fit(draw, draw(TRUTH), SPACE, **more, **HERE)
    np.testing.assert_array_equal(on.curve, whole.curve)


@pytest.mark.parametrize("until", ["solved", "stalled"])
def test_a_fit_to_a_noisy_picture_ends_when_its_noise_is_left(until: str) -> None:
    """The renderer has none.  The answer is as near as noise allows: 4 standard deviations."""
    std, step = 0.03, 1e-4
    slopes = [
        (draw({**TRUTH, name: TRUTH[name] + step}) - draw(TRUTH)).ravel() / step for name in TRUTH
    ]
    allowed = std * np.sqrt(np.diag(np.linalg.inv(np.array(slopes) @ np.array(slopes).T)))
    for seed in range(3):
        noise = np.random.default_rng(seed).normal(0, std, (48, 48))
        target = np.clip(draw(TRUTH) + noise, 0, 1)
        result = fit(draw, target, SPACE, budget=1500, until=until, workers=0, seed=seed)
        assert (result.stopped, result.status.code) == ("noise", "noise")
        assert result.evaluations < 500 and f"{std:.2g}" in result.status.sentence
        errors = [abs(result.params[name] - TRUTH[name]) for name in TRUTH]
        assert (np.array(errors) < 4 * allowed).all()


@pytest.mark.parametrize("contrast", [0.002, 0.05])
def test_a_faint_picture_is_solved_no_sooner_than_a_strong_one(contrast: float) -> None:
    """Floats, as of a microscope: to 8 bits they are of one color."""

    def faint(p: Mapping[str, float]) -> Float64:
        return np.asarray(0.5 + contrast * (draw(p) - 0.1), np.float64)

    result = fit(faint, faint(TRUTH), SPACE, budget=600, **HERE)
    assert result.stopped == "solved"
    assert result.params == pytest.approx(TRUTH, abs=0.002)


@pytest.mark.parametrize("gray", np.linspace(0, 0.09, 4))
def test_a_perfect_fit_to_a_picture_of_8_bits_is_solved(gray: float) -> None:
    """Its flat background is rounded, everywhere alike."""

    def lighter(p: Mapping[str, float]) -> Float64:
        return np.asarray(draw(p) + gray, np.float64)

    target = np.round(255 * lighter(TRUTH)).astype(np.uint8)
    result = fit(lighter, target, SPACE, x0=TRUTH, sigma0=0.01, budget=50, **HERE)
    assert (result.stopped, result.evaluations) == ("solved", 1)


def test_noise_of_the_renderer_ends_a_fit_only_if_told() -> None:
    """It is averaged: more renders tell more."""

    def stopped(until: str) -> tuple[str, str]:
        rng = np.random.default_rng(5)

        def noisy(p: Mapping[str, float]) -> Float64:
            return np.clip(draw(p) + rng.normal(0, 0.03, (48, 48)), 0, 1)

        result = fit(noisy, draw(TRUTH), SPACE, budget=500, until=until, **HERE)
        return result.stopped, result.status.code

    assert stopped("solved") == ("budget", "noise")
    assert stopped("stalled") == ("stalled", "noise")


@pytest.mark.parametrize(
    ("code", "improved_at", "evaluations", "over"),
    [
        ("noise", 8, 16, True),  # the renderer has noise
        ("agreed", 8, 400, True),
        ("unsure", 8, 400, False),  # moves have not had their chance
        ("unsure", 8, 1208, True),
        ("unsure", 2000, 3992, False),  # what took long may take as long again
        ("unsure", 2000, 4000, True),
        ("improving", 8, 5000, False),
    ],
)
def test_a_fit_is_stalled_after_many_moves(
    code: str, improved_at: int, evaluations: int, over: bool
) -> None:
    state = SimpleNamespace(
        evaluations=evaluations, improved_at=improved_at, retargeted_at=0, best=None,
        pixel_noise=SimpleNamespace(variance=0.01),
    )  # fmt: skip
    optimizer: Any = SimpleNamespace(
        popsize=8, dim=4, state=state, status=SimpleNamespace(code=code),
        views=SimpleNamespace(numbers=256),
    )  # fmt: skip
    losses = [1.0] * (evaluations - 1) + [0.1]
    reached = Stopping(None, until="stalled").reached(losses, 1.0, 0.1, True, optimizer)
    assert reached == ("stalled" if over else None)
    assert Stopping(None).reached(losses, 1.0, 0.1, True, optimizer) is None


def test_of_budget_and_time_the_one_that_is_spent_more_counts() -> None:
    for budget, seconds, share in ((None, 5.0, 0.25), (10, 5.0, 0.7), (10, 16.0, 0.8)):
        left = budget - 7 if budget else np.inf
        assert Stopping(budget, seconds=20.0).spent(7, seconds) == (share, left)
