"""Training in the background changes nothing but the time; what it raises is not lost."""

from __future__ import annotations

import copy
import pickle
import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins.proposers.base import ProposerDefaults
from fide_plugins.proposers.diffusion import BackgroundProposer
from fide_plugins.runtime.schema import Sides
from fide_plugins.types import Float64

Z = np.zeros((2, 3))
RNG = np.random.default_rng(0)


class Slow(ProposerDefaults):
    """Learns as soon as it is let, and says in which thread."""

    ready = True

    def __init__(self) -> None:
        self.learned: list[float] = []
        self.threads: list[str] = []

    def update(self, x: Float64, tokens: Tensor, losses: Float64, std: Float64) -> None:
        assert GATE.wait(20)
        if not np.isfinite(losses).all():
            raise ArithmeticError("it diverged")
        self.learned.append(float(losses.sum()))
        self.threads.append(threading.current_thread().name)

    def propose(self, z: Float64, *others: Any) -> Float64:
        return z + sum(self.learned)

    def forget(self) -> None:
        self.learned = []

    def state_dict(self) -> dict[str, Any]:
        return {"learned": list(self.learned)}

    def load_state_dict(self, state: Mapping[str, Any], sides: Sides | None = None) -> None:
        self.learned = list(state["learned"])

    def preview(self, *results: object) -> Slow:
        return self


GATE = threading.Event()


@pytest.fixture(autouse=True)
def gate() -> Any:
    GATE.clear()
    yield
    GATE.set()


def taught(loss: float = 1.0) -> tuple[BackgroundProposer, Slow]:
    """Proposer in the middle of training."""
    inner = Slow()
    proposer = BackgroundProposer(inner)
    proposer.update(Z, torch.zeros(2, 1, 1), np.full(2, loss), np.ones(3))
    return proposer, inner


def propose(proposer: BackgroundProposer) -> Float64:
    return proposer.propose(Z, torch.zeros(1, 1), Z[0], np.ones(3), RNG)


def test_busy_while_it_learns() -> None:
    proposer, _ = taught()
    assert proposer.busy
    GATE.set()
    propose(proposer)
    assert not proposer.busy


class Place:
    """Stands for a CUDA device or stream, of which each thread has its own."""

    here = threading.local()

    def __init__(self, name: str) -> None:
        self.name, self.waited = name, False

    def __enter__(self) -> None:
        Place.here.names = [*getattr(Place.here, "names", []), self.name]

    def __exit__(self, *exception: object) -> None:
        Place.here.names = Place.here.names[:-1]

    def synchronize(self) -> None:
        self.waited = True


def test_update_returns_before_training_is_over_and_proposals_wait_for_it() -> None:
    proposer, inner = taught()
    assert proposer.ready and inner.learned == []
    threading.Timer(0.05, GATE.set).start()
    np.testing.assert_array_equal(propose(proposer), Z + 2)
    assert inner.threads != [threading.current_thread().name]


@pytest.mark.parametrize("what", ["state_dict", "forget", "copy", "pickle"])
def test_whatever_looks_at_it_waits(what: str) -> None:
    proposer, inner = taught()
    threading.Timer(0.05, GATE.set).start()
    if what == "state_dict":
        assert proposer.state_dict() == {"learned": [2.0]}
    elif what == "forget":
        proposer.forget()
        assert inner.threads and inner.learned == []
    else:
        how: Any = copy.deepcopy if what == "copy" else (lambda p: pickle.loads(pickle.dumps(p)))
        twin = how(proposer)
        assert twin.state_dict() == {"learned": [2.0]}
        twin.update(Z, torch.zeros(2, 1, 1), np.ones(2), np.ones(3))
        assert twin.state_dict() == {"learned": [2.0, 2.0]}
        assert proposer.state_dict() == {"learned": [2.0]}


@pytest.mark.parametrize("by", ["propose", "update", "state_dict"])
def test_what_training_raises_is_raised_once_by_whoever_waits(by: str) -> None:
    GATE.set()
    proposer, _ = taught(loss=np.nan)
    with pytest.raises(ArithmeticError, match="diverged") as caught:
        if by == "propose":
            propose(proposer)
        elif by == "update":
            proposer.update(Z, torch.zeros(2, 1, 1), np.ones(2), np.ones(3))
        else:
            proposer.state_dict()
    assert caught.value.__notes__ == ["raised in the background, by training of the denoiser"]
    learned = 2 if by == "update" else 0  # from what came with the question itself
    np.testing.assert_array_equal(propose(proposer), Z + learned)  # and it goes on
    proposer.update(Z, torch.zeros(2, 1, 1), np.ones(2), np.ones(3))
    np.testing.assert_array_equal(propose(proposer), Z + learned + 2)
