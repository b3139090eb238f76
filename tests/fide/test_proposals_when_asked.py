"""Proposals are made when they are asked for, from all that was told by then."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64

from .helpers import Render

SETTINGS: dict[str, Any] = {
    "popsize": 8,
    "seed": 3,
    "proposal_fraction": 0.7,
    "guard_images": False,
}


def one_by_one(opt: FIDE, render: Render, n: int) -> Float64:
    asked = []
    for _ in range(n):
        X = opt.ask(1)
        opt.tell(X, render(X))
        asked.append(X)
    return np.concatenate(asked)


@pytest.mark.parametrize("proposer", ["linear"])
def test_asked_one_by_one_each_proposal_knows_all_that_was_told(
    proposer: str, render: Render, target: Float32, monkeypatch: pytest.MonkeyPatch
) -> None:
    opt = FIDE(6, target, proposer=proposer, **SETTINGS)
    one_by_one(opt, render, 24)
    known = []
    model = opt.state.proposer
    assert model is not None
    learn = model.update

    def update(x: Float64, *others: Any) -> None:
        known.extend(x.tolist())
        learn(x, *others)

    monkeypatch.setattr(model, "update", update)
    for _ in range(8):
        X = opt.ask(1)
        waiting = next(iter(opt.state.population.pending.values()))
        if waiting.proposed:
            assert len(opt.state.samples) == 0 and len(known) == len(opt.state.learned)
        opt.tell(X, render(X))
    assert len(known) == 8  # each was learned from once


@pytest.mark.parametrize("n", [4, 8, 20])
def test_proposals_asked_together_are_made_by_one_call_a_generation(
    n: int, render: Render, target: Float32, monkeypatch: pytest.MonkeyPatch
) -> None:
    opt = FIDE(6, target, proposer="linear", **SETTINGS)
    one_by_one(opt, render, 24)
    model = opt.state.proposer
    assert model is not None
    calls: list[int] = []
    propose = model.propose

    def counted(z: Float64, *others: Any) -> Any:
        calls.append(len(z))
        return propose(z, *others)

    monkeypatch.setattr(model, "propose", counted)
    for _ in range(3):
        calls.clear()
        X = opt.ask(n)
        made = sum(one.proposed for one in opt.state.population.pending.values())
        assert sum(calls) == made and len(calls) <= -(-n // 8) + 1
        opt.tell(X, render(X))
