"""Rendering while the network trains: the same run, to the bit."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64

from .helpers import Render, StateOf

PAPER: dict[str, Any] = {"preset": "paper", "popsize": 8, "epochs": 2, "batch_size": 4}


def run(opt: FIDE, render: Render, generations: int) -> list[Float64]:
    """By `ask_ready`; whatever comes is told at once."""
    asked, until = [], opt.state.population.generations + generations
    while opt.state.population.generations < until:
        asked.append(opt.ask_ready())
        opt.tell(asked[-1], render(asked[-1]))
    return asked


def comparable(opt: FIDE, state_of: StateOf) -> bytes:
    opt.options = FIDE(6, opt.target, **PAPER).options
    return state_of(opt)


def test_with_and_without_background_training_bit_for_bit(
    target: Float32, render: Render, state_of: StateOf
) -> None:
    beside = FIDE(6, target, seed=1, **PAPER)
    waiting = FIDE(6, target, seed=1, background_training=False, **PAPER)
    mine = np.concatenate(run(beside, render, 4))
    np.testing.assert_array_equal(mine, np.concatenate(run(waiting, render, 4)))
    assert comparable(beside, state_of) == comparable(waiting, state_of)


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
    for background in (True, False):
        opt = FIDE(6, target, seed=3, background_training=background, **PAPER)
        first, more = opt.ask(), opt.ask(4)
        opt.tell(first, render(first))
        late = opt.ask(4)  # of the next generation, before its proposals
        X = np.concatenate([more, late])
        opt.tell(X, render(X))
        run(opt, render, 1)
        states.append(comparable(opt, state_of))
    assert states[0] == states[1]


@pytest.mark.parametrize("background", [True, False])
@pytest.mark.parametrize("error", [MemoryError("too large"), KeyboardInterrupt()])
def test_a_generation_whose_training_raises_is_not_lost(
    background: bool, error: BaseException, target: Float32, render: Render
) -> None:
    """The search learns from it, and everything told with it is noted, before that is raised."""
    opt, other = (
        FIDE(6, target, seed=1, background_training=background, **PAPER) for _ in range(2)
    )
    network: Any = opt.state.proposer
    network = getattr(network, "_proposer", network)
    rest = np.random.default_rng(0).random((3, 6))  # which were never asked

    def fail(*arguments: object) -> None:
        raise error

    X = opt.ask()
    np.testing.assert_array_equal(other.ask(), X)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(network, "update", fail)
        with pytest.raises(type(error)):
            opt.tell(np.concatenate([X, rest]), render(np.concatenate([X, rest])))
            opt.save(os.devnull)  # in the background it is raised by whatever waits
    other.tell(np.concatenate([X, rest]), render(np.concatenate([X, rest])))
    assert opt.evaluations == other.evaluations == 11
    assert opt.state.population.generations == 1
    np.testing.assert_array_equal(opt.state.search.mean, other.state.search.mean)
    run(opt, render, 2)  # and it goes on
