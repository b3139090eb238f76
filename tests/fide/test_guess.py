"""A guess, `x0`: the first candidate, one of its generation, and never better than `best`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from fide_plugins import Choice, Float, Int, Space
from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64

from .helpers import TINY, TINY_PAPER, Render, run

SPACES: dict[str, Space | int] = {
    "cube": 6,
    "floats": Space(a=Float(-60, 60), b=Float(0.1, 9, log=True), c=Float(0, 360, periodic=True)),
    "mixed": Space(n=Int(1, 8), kind=Choice("a", "b", "c"), two=Choice("x", "y"), c=Float(5, 6)),
    "whole": Space(n=Int(0, 2), m=Int(-4, 4), k=Int(1, 1000, log=True)),
}
PRESETS: dict[str, dict[str, Any]] = {
    "fast": {"preset": "fast"},
    "balanced": {"popsize": 5},
    "accurate": {"preset": "accurate"},
    "paper": TINY_PAPER,
    "losses only": {"proposer": "none", "popsize": 4},
    "many parameters": {"popsize": 4, "sigma0": 0.01},
}
WAYS: dict[str, Callable[[FIDE], Float64]] = {
    "ask()": lambda opt: opt.ask(),
    "ask(1)": lambda opt: opt.ask(1),
    "ask(20)": lambda opt: opt.ask(20),
    "ask_ready()": lambda opt: opt.ask_ready(),
}


def dim_of(space: Space | int) -> int:
    return space.dim if isinstance(space, Space) else space


def placed(space: Space | int, x: Float64) -> Float64:
    """The point (d,) as it is rendered."""
    return space.snap(x) if isinstance(space, Space) else x


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("kind", SPACES)
def test_it_is_the_first_candidate_to_the_bit(kind: str, way: str) -> None:
    """However it is asked; told before it or not."""
    space = SPACES[kind]
    for seed in range(3):
        x = np.random.default_rng(seed).random(dim_of(space))
        opt = FIDE(space, TINY, x0=x, seed=seed)
        if seed:  # a point of the user's own comes before
            opt.tell(np.full((1, opt.dim), 0.25), losses=[1.0])
        X = WAYS[way](opt)
        np.testing.assert_array_equal(X[0], placed(space, x))
        again = opt.ask(30)
        assert not (isinstance(space, int) and (again == x).all(axis=1).any())  # once


def test_all_others_are_those_of_the_same_seed() -> None:
    """Nothing is drawn for it, so that a run without a guess is what it was."""
    with_it = FIDE(4, TINY, x0=np.full(4, 0.5), popsize=6, seed=3).ask(15)
    without = FIDE(4, TINY, popsize=6, seed=3).ask(15)
    np.testing.assert_array_equal(with_it[1:], without[1:])
    assert not (without == 0.5).all(axis=1).any()


@pytest.mark.parametrize("when", ["before", "pending"])
@pytest.mark.parametrize("x0", [None, np.full(6, 0.5), np.linspace(0, 1, 6)])
def test_it_survives_a_checkpoint(
    x0: Float64 | None, when: str, target: Float32, render: Render, tmp_path: Path
) -> None:
    opt = FIDE(6, target, x0=x0, popsize=6, seed=0)
    asked = opt.ask(2) if when == "pending" else np.empty((0, 6))
    opt.save(tmp_path / "c")
    copy = FIDE.load(tmp_path / "c")
    for one in (opt, copy):
        if len(asked):
            one.tell(asked, render(asked))
    np.testing.assert_array_equal(run(opt, render, 4), run(copy, render, 4))


# -- the next picture ------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{"proposer": "none"}, {"memory_mb": 0}, {}])
def test_the_next_picture_begins_where_the_last_search_ended(
    options: dict[str, Any], target: Float32, render: Render
) -> None:
    opt = FIDE(6, target, popsize=8, seed=0, **options)
    run(opt, render, 10)
    assert opt.best is not None
    best = opt.best.x
    opt.retarget(target)
    np.testing.assert_array_equal(opt.ask(1)[0], best)


# -- in many processes -----------------------------------------------------------------------------


# -- what it is worth ------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 10**6),
    preset=st.sampled_from(list(PRESETS)),
    kind=st.sampled_from(list(SPACES)),
    renders=st.integers(1, 20),
    near=st.sampled_from([0.0, 1e-3, 0.3]),
)
@settings(max_examples=15, deadline=None)
def test_best_is_never_worse(seed: int, preset: str, kind: str, renders: int, near: float) -> None:
    """Whatever follows it; asked one at a time or by generations."""
    rng = np.random.default_rng(seed)
    space = SPACES[kind]
    answer, other = rng.random((2, dim_of(space)))
    x = np.clip(answer + near * (other - answer), 0, 1)
    by_one = {} if seed % 2 else {"n": 1}
    opt = FIDE(space, np.zeros((8, 8, 3)), x0=x, seed=seed, **PRESETS[preset])

    def losses(X: Float64) -> Float64:
        found: Float64 = np.abs(X - answer).sum(axis=1)
        return found

    while opt.evaluations < renders:
        X = opt.ask(**by_one)
        opt.tell(X, losses=losses(X))
    assert opt.best is not None
    assert opt.best.loss <= losses(placed(space, x)[None])[0]
