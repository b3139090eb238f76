"""Rendering while the network trains: the same run, to the bit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest

from fide_plugins import harness
from fide_plugins.fide import FIDE
from fide_plugins.images import Float32
from fide_plugins.points import Float64

Render: TypeAlias = Callable[[Float64], Float32]
StateOf: TypeAlias = Callable[[FIDE], bytes]
PAPER: dict[str, Any] = {"preset": "paper", "popsize": 8, "epochs": 2, "batch_size": 4}


def run(opt: FIDE, render: Render, generations: int) -> list[Float64]:
    """By `ask_ready`; whatever comes is told at once."""
    asked, until = [], opt._ledger.generations + generations
    while opt._ledger.generations < until:
        asked.append(opt.ask_ready())
        opt.tell(asked[-1], render(asked[-1]))
    return asked


def comparable(opt: FIDE, state_of: StateOf) -> bytes:
    opt.options = FIDE(6, opt.target, **PAPER).options
    return state_of(opt)


def test_with_and_without_overlap_bit_for_bit(
    target: Float32, render: Render, state_of: StateOf
) -> None:
    beside = FIDE(6, target, seed=1, **PAPER)
    waiting = FIDE(6, target, seed=1, overlap=False, **PAPER)
    mine = np.concatenate(run(beside, render, 4))
    np.testing.assert_array_equal(mine, np.concatenate(run(waiting, render, 4)))
    assert comparable(beside, state_of) == comparable(waiting, state_of)


def test_half_of_a_generation_does_not_wait(target: Float32, render: Render) -> None:
    opt = FIDE(6, target, seed=1, **PAPER)
    assert [len(X) for X in run(opt, render, 3)] == [4] * 6
    assert opt.ask().shape == (8, 6)  # and who asks for all gets all


def test_the_closed_form_has_nothing_to_wait_for(target: Float32, render: Render) -> None:
    opt = FIDE(6, target, seed=1, popsize=8)
    for _ in range(4):
        X = opt.ask_ready()
        assert X.shape == (8, 6)
        opt.tell(X, render(X))


def test_saved_while_it_trains_it_goes_on_bit_for_bit(
    target: Float32, render: Render, state_of: StateOf, tmp_path: Path
) -> None:
    opt = FIDE(6, target, seed=2, **PAPER)
    run(opt, render, 2)
    X = opt.ask(2)  # training is under way, proposals are due
    opt.save(tmp_path / "c")
    copy = FIDE.load(tmp_path / "c")
    for each in (opt, copy):
        each.tell(X, render(X))
        rest = each.ask()
        each.tell(rest, render(rest))
        run(each, render, 2)
    assert state_of(copy) == state_of(opt)


def test_a_generation_that_is_complete_before_its_proposals_are_due(
    target: Float32, render: Render, state_of: StateOf
) -> None:
    """Candidates of the last one come back late and take the places; nothing is proposed then."""
    states = []
    for overlap in (True, False):
        opt = FIDE(6, target, seed=3, overlap=overlap, **PAPER)
        first, more = opt.ask(), opt.ask(4)
        opt.tell(first, render(first))
        late = opt.ask(4)  # of the next generation, before its proposals
        X = np.concatenate([more, late])
        opt.tell(X, render(X))
        run(opt, render, 1)
        states.append(comparable(opt, state_of))
    assert states[0] == states[1]


def test_what_training_raises_comes_with_the_next_question_and_loses_no_candidate(
    target: Float32, render: Render, monkeypatch: pytest.MonkeyPatch
) -> None:
    opt = FIDE(6, target, seed=1, **PAPER)
    proposer: Any = opt._proposer

    def fail(*arguments: object) -> None:
        raise MemoryError("too large")

    with monkeypatch.context() as patch:
        patch.setattr(proposer._proposer, "update", fail)
        X = opt.ask()
        opt.tell(X, render(X))
        assert opt.evaluations == 8
        X = opt.ask_ready()
        opt.tell(X, render(X))
        with pytest.raises(MemoryError, match="too large") as caught:
            opt.ask()
        assert "training of the denoiser" in caught.value.__notes__[0]
    rest = opt.ask()
    assert rest.shape == (4, 6)
    opt.tell(rest, render(rest))
    assert opt._ledger.generations == 2
    run(opt, render, 2)


class Disks:
    """Task of the harness."""

    name, dim, seed = "disks", 6, 0

    def __init__(self, target: Float32, render: Render) -> None:
        self.target, self._draw = target, render

    def render(self, X: Float64, seed: Any = None) -> Float32:
        return self._draw(X)


def test_the_run_loop_renders_meanwhile(target: Float32, render: Render) -> None:
    """Without a change of the result, and in generations of which half is asked first."""
    task = Disks(target, render)
    results = [
        harness.prepare(task, "fide", "mse", 40, 0, options={**PAPER, "overlap": o}).execute()
        for o in (True, False)
    ]
    np.testing.assert_array_equal(results[0].losses, results[1].losses)
    assert results[0].generations.tolist() == [4] * 10
    assert results[1].generations.tolist() == [8] * 5
