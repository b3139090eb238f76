"""Steps between two generations, as who asks sees them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins.fide import FIDE
from fide_plugins.population import CandidateRole
from fide_plugins.space import Int, Space
from fide_plugins.types import Float32, Float64

from .helpers import Render

SETTINGS: dict[str, Any] = {"popsize": 8, "seed": 3}


def steps_pending(opt: FIDE) -> int:
    return sum(
        candidate.role is CandidateRole.STEP for candidate in opt.state.population.pending.values()
    )


def one_by_one(opt: FIDE, render: Render, n: int) -> tuple[Float64, list[bool]]:
    """Candidates (n, dim), and which were steps."""
    asked, steps = [], []
    for _ in range(n):
        asked.append(opt.ask(1))
        steps.append(steps_pending(opt) > 0)
        opt.tell(asked[-1], render(asked[-1]))
    return np.concatenate(asked), steps


def first_step(opt: FIDE, render: Render) -> Float64:
    """Ask and tell until a step is pending."""
    for _ in range(200):
        X = opt.ask(1)
        if steps_pending(opt):
            return X
        opt.tell(X, render(X))
    raise AssertionError("no step in 200 candidates")


def test_they_come_between_two_generations_and_count_in_none(
    render: Render, target: Float32
) -> None:
    opt = FIDE(6, target, **SETTINGS)
    _, steps = one_by_one(opt, render, 120)
    flags = np.array(steps)
    assert flags.sum() > 10
    ends = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    assert (ends[1::2] - ends[::2]).max() <= 3 * 8  # of steps in a row
    assert not flags[:8].any()
    members = np.cumsum(~flags)
    begun = flags[1:] & ~flags[:-1]
    assert (members[1:][begun] % 8 == 0).all()  # after whole generations only
    assert opt.state.population.generations == members[-1] // 8


def test_the_first_search_converges_faster_with_them(render: Render, target: Float32) -> None:
    reached = []
    for proposer in ("linear", "both"):
        runs = []
        for seed in range(5):
            opt = FIDE(6, target, popsize=8, seed=seed, proposer=proposer)
            one_by_one(opt, render, 100)
            assert opt.best is not None
            runs.append(opt.best.loss)
        reached.append(np.exp(np.mean(np.log(np.array(runs) + 1e-15))))
    assert reached[1] < reached[0] / 5


def test_who_asks_for_many_gets_steps_and_then_a_generation(
    render: Render, target: Float32, tmp_path: Path
) -> None:
    opt = FIDE(6, target, **SETTINGS)
    opt.tell(X := first_step(opt, render), render(X))
    assert opt.state.steps is not None
    left = opt.state.steps.remaining
    X = opt.ask(40)
    assert X.shape == (40, 6) and len(np.unique(X, axis=0)) == 40
    assert 0 < steps_pending(opt) == left < 3 * 8
    opt.save(tmp_path / "c")
    FIDE.load(tmp_path / "c")
    while opt.state.population.remaining:
        opt.ask(1)
    opt.ask(1)  # of the next generation
    opt.tell(X, render(X))


def test_saved_between_two_steps_it_goes_on_bit_for_bit(
    render: Render, target: Float32, tmp_path: Path
) -> None:
    opt = FIDE(6, target, **SETTINGS)
    X = first_step(opt, render)
    opt.save(tmp_path / "c")
    copy = FIDE.load(tmp_path / "c")
    for each in (opt, copy):
        each.tell(X, render(X))
    asked, steps = one_by_one(opt, render, 40)
    assert any(steps)
    np.testing.assert_array_equal(one_by_one(copy, render, 40)[0], asked)


def test_what_fails_after_the_steps_hands_out_none(
    render: Render, target: Float32, monkeypatch: pytest.MonkeyPatch
) -> None:
    opt = FIDE(6, target, **SETTINGS)
    X = first_step(opt, render)
    opt.tell(X, render(X))

    def broken(*_: Any) -> None:
        raise ArithmeticError

    with monkeypatch.context() as patched:
        patched.setattr(FIDE, "_make_next", broken)
        with pytest.raises(ArithmeticError):
            opt.ask(20)
    assert len(opt.state.population.pending) == 0
    opt.tell(X := opt.ask(1), render(X))


@pytest.mark.thorough
@pytest.mark.parametrize(("n", "out"), [(1, 1), (1, 6), (12, 12)])
def test_integers_bring_no_step_twice(n: int, out: int) -> None:
    """Asked n at a time, and told when so many are out."""
    space = Space(a=Int(0, 20), b=Int(0, 20))
    grid = np.linspace(0, 1, 24)

    def draw(X: Float64) -> Float32:
        bumps = np.exp(-np.square((grid - X[:, :1]) * 4))[:, :, None]
        images = bumps * np.exp(-np.square((grid - X[:, 1:]) * 4))[:, None]
        return np.repeat(images[..., None], 3, 3).astype(np.float32)

    steps = 0
    for seed in range(6):
        opt, seen = FIDE(space, draw(np.array([[0.62, 0.4]]))[0], popsize=8, seed=seed), set()
        queue: list[Float64] = []
        while opt.evaluations < 150:
            before = steps_pending(opt)
            X = opt.ask(n)
            new = steps_pending(opt) - before  # which come first
            for i, x in enumerate(X):
                assert i >= new or x.tobytes() not in seen
                seen.add(x.tobytes())
            steps += new
            queue += list(X)
            while len(queue) >= out:
                opt.tell(queue[0][None], draw(queue.pop(0)[None]))
    assert steps > 0
