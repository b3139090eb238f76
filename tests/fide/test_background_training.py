"""Rendering while the network trains: the same run, to the bit."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fide_lab import run as harness
from fide_plugins.denoiser import network as network_module
from fide_plugins.fide import FIDE
from fide_plugins.recording import directory
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


def test_half_of_a_generation_does_not_wait(target: Float32, render: Render) -> None:
    opt = FIDE(6, target, seed=1, **PAPER)
    assert [len(X) for X in run(opt, render, 3)] == [4] * 6
    assert opt.ask().shape == (8, 6)  # and who asks for all gets all


def test_the_closed_form_has_nothing_to_wait_for(target: Float32, render: Render) -> None:
    opt = FIDE(6, target, seed=1, popsize=8, proposer="linear")
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


def test_what_training_raised_is_raised_by_the_next_generation_and_neither_is_lost(
    target: Float32, render: Render, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where late candidates complete it, so that no proposals were waited for."""
    opt = FIDE(6, target, seed=3, **PAPER)
    proposer: Any = opt.state.proposer
    first, more = opt.ask(), opt.ask(4)
    with monkeypatch.context() as patch:
        patch.setattr(proposer._proposer, "update", lambda *arguments: 1 / 0)
        opt.tell(first, render(first))
        proposer._training.join()
    late = opt.ask(4)
    X, mean = np.concatenate([more, late]), opt.state.search.mean.copy()
    with pytest.raises(ZeroDivisionError):
        opt.tell(X, render(X))
    assert opt.state.population.generations == 2 and opt.evaluations == 16
    assert not np.array_equal(opt.state.search.mean, mean)
    run(opt, render, 1)
    proposer._training.join()
    assert proposer._proposer.updates == 2  # of the second generation, and of the third


def test_no_memory_for_features_changes_nothing(
    target: Float32, render: Render, state_of: StateOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of a piece are kept one by one, all of them before the first result is noted."""
    opt = FIDE(6, target, seed=1, popsize=8)
    X = opt.ask()
    before, clone, made = state_of(opt), torch.Tensor.clone, []

    def small(tensor: torch.Tensor, **options: Any) -> torch.Tensor:
        made.append(1)
        if len(made) == 5:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return clone(tensor, **options)

    with monkeypatch.context() as patch:
        patch.setattr(torch.Tensor, "clone", small)
        with pytest.raises(torch.OutOfMemoryError):
            opt.tell(X, render(X))
    assert state_of(opt) == before
    opt.tell(X, render(X))
    assert opt.evaluations == 8


def test_what_is_set_reaches_the_network(
    target: Float32, render: Render, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(network_module, "has_bfloat16", lambda device: True)
    own: dict[str, Any] = {"steps": 2, "precision": "bfloat16", "parameter_tokens": 3}
    opts = [FIDE(6, target, seed=1, **PAPER, **options) for options in (own, {})]
    for opt in opts:
        run(opt, render, 2)
    found = []
    for opt in opts:
        proposer: Any = opt.state.proposer
        proposer = proposer._proposer
        network = proposer._parts(*opt.features_shape)[0]
        found.append((proposer.schedule, proposer.precision, network.parameter_tokens))
    assert found == [((0.3, 0.15), "bfloat16", 3), ((0.3, 0.2, 0.1), "float32", 6)]


class Disks:
    """Task of the harness."""

    name, dim, seed = "disks", 6, 0

    def __init__(self, target: Float32, render: Render) -> None:
        self.target, self._draw = target, render

    def render(self, X: Float64, seed: Any = None) -> Float32:
        return self._draw(X)


def test_a_run_is_saved_when_nothing_trains(
    target: Float32, render: Render, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But at its end: when the proposals are there, which had to wait anyway."""
    saved: list[tuple[int, bool]] = []
    save = FIDE.save

    def watched(opt: FIDE, path: Path) -> None:
        saved.append((opt.evaluations, opt.training))
        save(opt, path)

    monkeypatch.setattr(FIDE, "save", watched)
    monkeypatch.setattr(directory, "_INTERVAL", 0)
    task, options = Disks(target, render), PAPER | {"epochs": 20}
    run = harness.prepare(
        task, "fide", "mse", 24, 0, options=options, out=tmp_path / "run", checkpoint_every=1e-9
    )
    run.execute()
    assert {4, 12, 20} <= {n for n, _ in saved}
    assert not any(training for n, training in saved if n < 24)


def test_the_run_loop_renders_meanwhile(target: Float32, render: Render) -> None:
    """Without a change of the result, and in generations of which half is asked first."""
    task = Disks(target, render)
    results = [
        harness.prepare(
            task, "fide", "mse", 40, 0, options={**PAPER, "background_training": o}
        ).execute()
        for o in (True, False)
    ]
    np.testing.assert_array_equal(results[0].losses, results[1].losses)
    assert results[0].generations.tolist() == [4] * 10
    assert results[1].generations.tolist() == [8] * 5
