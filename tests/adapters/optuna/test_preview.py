"""Candidates drawn when all of a generation are pending and some of its results are not known."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from fide_adapters.optuna.replica import Replica
from fide_plugins import encoders
from fide_plugins.fide import FIDE
from fide_plugins.types import Float32, Float64

DIM, SIZE = 6, 8
SETTINGS: dict[str, Any] = {"seed": 0, "popsize": SIZE, "patience": 50, "proposer": "both"}


def look(x: Float64) -> tuple[float, torch.Tensor]:
    """Loss of x (6,), and tokens of an image that shows it."""
    image = np.kron(x.reshape(2, 3), np.ones((4, 4)))[None, ..., None].repeat(3, axis=-1)
    return float(np.square(x - 0.3).sum()), encoders.make("dense")(image.astype(np.float32))[0]


TARGET: Float32 = np.full((8, 12, 3), 0.3, np.float32)


def replica_in_the_midst(told: int, **settings: object) -> Replica:
    """After three generations, with so many results of the fourth."""
    replica = Replica(FIDE(DIM, TARGET, **SETTINGS | settings))
    for slots in (SIZE, SIZE, SIZE, told):
        generation = replica.generation
        for slot in range(slots):
            x = replica.candidate(slot).x
            replica.tell(x, *look(x), generation=generation, slot=slot)
    return replica


def test_they_are_drawn_from_what_the_results_so_far_make_of_the_search() -> None:
    replica = replica_in_the_midst(6, proposer="none")
    members, losses = replica.optimizer.state.population.members()
    now = replica.optimizer.state.search.distribution
    ahead = now.preview(np.array([c.z for c in members]), losses, np.zeros(6, bool))
    z = np.array([replica.newest(slot, 2).z for slot in range(SIZE, SIZE + 400)])
    error = ahead.std / np.sqrt(len(z))
    assert (np.abs(z.mean(axis=0) - ahead.mean) < 4 * error).all()
    assert (np.abs(z.mean(axis=0) - now.mean) > 4 * error).any()
    np.testing.assert_allclose(z.std(axis=0), ahead.std, rtol=0.2)


def test_asking_for_them_changes_nothing() -> None:
    asked, idle = replica_in_the_midst(6), replica_in_the_midst(6)
    assert len({asked.newest(slot, 2).x.tobytes() for slot in range(SIZE, SIZE + 30)}) == 30
    for replica in (asked, idle):
        for slot in (6, 7):
            x = replica.candidate(slot).x
            replica.tell(x, *look(x), generation=3, slot=slot)
    assert asked.generation == idle.generation == 4
    for slot in range(SIZE):
        np.testing.assert_array_equal(asked.candidate(slot).x, idle.candidate(slot).x)


def test_what_the_generation_still_needs_is_a_member_of_it() -> None:
    """Some have failed, and nobody else is rendering enough to complete it."""
    replica = replica_in_the_midst(6)
    assert replica.newest(9, 1) is replica.candidate(9)
    assert replica.newest(9, 2) is not replica.candidate(9)
