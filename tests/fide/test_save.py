"""A saved optimizer goes on bit for bit, and nothing else is taken for one."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins.errors import (
    CheckpointError,
    LossError,
)
from fide_plugins.fide import FIDE
from fide_plugins.runtime import checkpoint
from fide_plugins.types import Float32, Float64

from .helpers import Render, StateOf

SETTINGS: dict[str, dict[str, Any]] = {
    "linear": {"popsize": 8, "patience": 4},
    "one search, one channel subset": {"popsize": 8, "restarts": "none", "channel_subsets": (3,)},
    "losses only": {"popsize": 8, "proposer": "none"},
    "paper": {"preset": "paper", "popsize": 6, "epochs": 1, "batch_size": 6},
    "other loss and encoder": {"popsize": 8, "loss": "perceptual", "encoder": "patch"},
}


def go_on(opt: FIDE, render: Render, steps: int) -> list[Float64]:
    """Ask and tell in pieces of three, which cut through generations."""
    asked = []
    for _ in range(steps):
        X = opt.ask(3)
        opt.tell(X[::-1], render(X[::-1]))
        asked.append(X)
    return asked


def begun(target: Float32, render: Render, settings: dict[str, Any], steps: int = 20) -> FIDE:
    """In the middle of a generation, with a queue, late ones outside, and an injected one."""
    opt = FIDE(6, target, seed=4, **settings)
    go_on(opt, render, steps)
    opt.ask(2)
    injected = np.full((1, 6), 0.6)
    opt.tell(injected, render(injected))
    return opt


@pytest.mark.parametrize("loss", [sys.float_info.max, -sys.float_info.max, 5e-324])
@pytest.mark.parametrize("proposer", ["linear", "none"])
def test_any_finite_loss_can_be_saved(
    loss: float, proposer: str, target: Float32, render: Render, tmp_path: Path
) -> None:
    """Some tell the largest number there is of a candidate that failed."""
    opt = FIDE(6, target, seed=4, popsize=8, proposer=proposer)
    for _ in range(3):
        X = opt.ask(5)  # results, candidates and an injected candidate are left over
        opt.tell(X, render(X), [loss, 3.0, 1.0, 2.0, 4.0])
        opt.tell([[0.5] * 6], render(X[:1]), [loss])
    opt.save(tmp_path / "c")
    copy = FIDE.load(tmp_path / "c")
    assert copy.best is not None and opt.best is not None and copy.best.loss == opt.best.loss
    np.testing.assert_array_equal(copy.ask(), opt.ask())


@pytest.mark.parametrize("steps", [0, 1, 20])
@pytest.mark.parametrize("what", SETTINGS)
def test_continues_bit_for_bit(
    what: str, steps: int, target: Float32, render: Render, state_of: StateOf, tmp_path: Path
) -> None:
    original = begun(target, render, SETTINGS[what], steps)
    original.save(tmp_path / "c")
    copy = FIDE.load(tmp_path / "c")
    assert state_of(copy) == state_of(original)
    assert copy.times == original.times
    for ours, theirs in zip(go_on(original, render, 14), go_on(copy, render, 14), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert state_of(copy) == state_of(original)
    assert original.best is not None and copy.best is not None
    np.testing.assert_array_equal(original.best.image, copy.best.image)


def test_candidates_that_were_out_may_be_told_to_the_copy(
    target: Float32, render: Render, tmp_path: Path
) -> None:
    original = FIDE(6, target, seed=0, popsize=8)
    X = original.ask()
    original.tell(X[:3], render(X[:3]))
    original.save(tmp_path / "c")
    copy = FIDE.load(tmp_path / "c")
    for opt in (original, copy):
        opt.tell(X[3:], render(X[3:]))
    np.testing.assert_array_equal(original.ask(), copy.ask())
    assert original.evaluations == copy.evaluations == 8


def mse(images: Float32) -> Float64:
    """Has the name of a loss of the library, and is none."""
    values: Float64 = images.mean(axis=(1, 2, 3)).astype(np.float64)
    return values


def test_a_callable_loss_must_be_given_again(
    target: Float32, render: Render, state_of: StateOf, tmp_path: Path
) -> None:
    original = begun(target, render, {"popsize": 8, "loss": mse})
    original.save(tmp_path / "c")
    copy, without = FIDE.load(tmp_path / "c", loss=mse), FIDE.load(tmp_path / "c")
    X = original.ask(3)
    np.testing.assert_array_equal(X, copy.ask(3))
    np.testing.assert_array_equal(X, without.ask(3))
    before = state_of(without)
    with pytest.raises(LossError, match="loss="):
        without.tell(X, render(X))
    assert state_of(without) == before
    for opt in (original, copy):
        opt.tell(X, render(X))
    without.tell(X, render(X), mse(render(X)))
    np.testing.assert_array_equal(original.ask(8), copy.ask(8))
    assert state_of(copy) == state_of(original)
    without.save(tmp_path / "again")
    with pytest.raises(LossError, match="loss="):
        FIDE.load(tmp_path / "again").tell(X, render(X))


def test_going_on_asks_for_the_same_arguments(target: Float32, tmp_path: Path) -> None:
    """A checkpoint of another target is whole, and nobody needs to start again."""
    FIDE(6, target, popsize=8, seed=0).save(tmp_path / "a")
    other = FIDE(6, 1 - target, popsize=8, seed=0)
    with pytest.raises(CheckpointError, match="/a: it was saved with another target; give the"):
        other.continue_from(tmp_path / "a")
    assert other.best is None


def with_entry(saved: Any, place: str, value: object) -> dict[str, Any]:
    """A copy of a checkpoint with another value at a place, such as "state.best"."""
    head, _, rest = place.partition(".")
    return {**saved, head: with_entry(saved[head], rest, value) if rest else value}


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("settings", None),
        ("settings.surprise", 1),
        ("settings.dim", "six"),
        ("settings.target", np.zeros(3)),
        ("loss", "surprise"),
        ("state", None),
        ("state.surprise", 1),
        ("state.rng", {}),
        ("state.search", None),
        ("state.population", {"size": 8}),
        ("state.proposer", None),
        ("state.best", {"y": 1}),
        ("state.samples", [{"index": 1}]),
        ("state.relocation", []),
        ("state.gate", {}),
        ("state.stage", "rest"),
        ("state.search_best", {"x": 0}),
        ("state.versions", None),
    ],
)
def test_impossible_contents(
    place: str, value: object, target: Float32, render: Render, tmp_path: Path
) -> None:
    """A file with the right checksum that somebody else wrote."""
    begun(target, render, {"popsize": 8}).save(tmp_path / "c")
    saved = checkpoint.read(tmp_path / "c", "fide")
    checkpoint.write(tmp_path / "c", "fide", with_entry(saved, place, value))
    with pytest.raises(CheckpointError, match="impossible contents"):
        FIDE.load(tmp_path / "c")


def test_a_state_that_is_none_leaves_the_optimizer_as_it_was(
    target: Float32, render: Render, state_of: StateOf
) -> None:
    """Also one whose last parts are wrong, when all others could be loaded."""
    opt, other = (begun(target, render, {"popsize": 8}) for _ in range(2))
    go_on(other, render, 9)
    before, held = state_of(opt), opt.state
    for place in ("best", "searches", "proposer", "gate", "search_best", "times"):
        state = dict(other.state_dict(), **{place: "nothing of the kind"})
        with pytest.raises((ValueError, TypeError, KeyError)):
            opt.load_state_dict(state)
        assert opt.state is held and state_of(opt) == before
    same = begun(target, render, {"popsize": 8})
    np.testing.assert_array_equal(go_on(opt, render, 5), go_on(same, render, 5))


def test_loading_waits_for_who_asks_or_tells(target: Float32, render: Render) -> None:
    opt = begun(target, render, {"popsize": 8})
    state = opt.state_dict()
    thread = threading.Thread(target=opt.load_state_dict, args=(state,))
    with opt._lock.held:
        held = opt.state
        thread.start()
        thread.join(0.2)
        assert thread.is_alive() and opt.state is held
    thread.join()
    assert opt.state is not held


@pytest.mark.parametrize("state", [{}, {"versions": {}}, {"versions": None}, None])
def test_what_is_no_state_is_a_value_error(target: Float32, state: Any) -> None:
    with pytest.raises(ValueError):
        FIDE(6, target).load_state_dict(state)
