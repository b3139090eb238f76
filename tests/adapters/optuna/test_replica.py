"""Optimizers in several processes, which are told one log and agree on everything."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import pytest
import torch

from fide_adapters.optuna.replica import Replica, Role
from fide_plugins import encoders
from fide_plugins.fide import FIDE
from fide_plugins.proposers.image_gate import ImageGate
from fide_plugins.types import Float32, Float64

Render: TypeAlias = Callable[[Float64], Float32]

DIM = 6


class Bench:
    """A renderer, and replicas of one optimizer of its target."""

    def __init__(self, render: Render, target: Float32) -> None:
        self._render, self.target = render, target
        self._encode = encoders.make("dense")

    def optimizer(self, **settings: Any) -> FIDE:
        # so little patience that a run of a few hundred renders has searches, tests and restarts
        return FIDE(DIM, self.target, **{"seed": 0, "popsize": 8, "patience": 2, **settings})

    def look(self, x: Float64) -> tuple[float, torch.Tensor]:
        image = self._render(x[None])
        loss = float(np.square(image[0].astype(np.float64) - self.target).mean())
        return loss, self._encode(image)[0]

    def told(self, replica: Replica, slot: int) -> Role:
        x = replica.candidate(slot).x
        return replica.tell(x, *self.look(x), generation=replica.generation, slot=slot)


@pytest.fixture
def bench(render: Render, target: Float32) -> Bench:
    return Bench(render, target)


def stages(replica: Replica) -> tuple[str, int]:
    return replica.optimizer.state.moves.stage.value, replica.optimizer.state.searches


def run(bench: Bench, replica: Replica, entries: int, first: int = 0) -> list[tuple[int, Float64]]:
    """Tell slots in order; return generations and candidates."""
    asked: list[tuple[int, Float64]] = []
    generation, slot = replica.generation, first
    while len(asked) < entries:
        if replica.generation != generation:
            generation, slot = replica.generation, first
        asked.append((generation, replica.candidate(slot).x.copy()))
        assert bench.told(replica, slot) is Role.MEMBER
        slot += 1
    return asked


def test_a_replica_alone_is_the_optimizer(bench: Bench) -> None:
    """That of one who asks whole generations: it hands out all proposals of one at once.

    But for rounding: a product of several rows need not be that of each row, in the last digit.
    """
    replica, plain = Replica(bench.optimizer()), bench.optimizer()
    plain.state.stay_sharp()
    seen = set()
    while plain.evaluations < 400:
        seen.add(plain.state.moves.stage.value)
        assert stages(replica) == (plain.state.moves.stage.value, plain.state.searches)
        X = plain.ask()
        assert replica.size == len(X)
        for slot, x in enumerate(X):
            np.testing.assert_allclose(replica.candidate(slot).x, x, rtol=0, atol=1e-6)
        losses, tokens = zip(*map(bench.look, X), strict=True)
        for slot in range(len(X)):
            assert bench.told(replica, slot) is Role.MEMBER
        plain.enter(X, plain.evaluator.evaluate(len(X), None, losses, torch.stack(tokens)))
    assert {"search", "exchange", "restart"} <= seen
    assert replica.optimizer.best is not None and plain.best is not None
    assert replica.optimizer.best.loss == pytest.approx(plain.best.loss, rel=1e-3)


def soft_disks(X: Float64) -> Float32:
    """Images (n, 24, 24, 3) of soft disks that are exchangeable, each of x, y and gray."""
    v, u = np.mgrid[0:24, 0:24] / 23
    disks = X.reshape(len(X), -1, 3, 1, 1)
    near = np.exp(-40 * ((u - disks[:, :, 0]) ** 2 + (v - disks[:, :, 1]) ** 2))
    gray = (0.1 + 0.2 * disks[:, :, 2]) * near
    return np.repeat(gray.sum(axis=1)[..., None], 3, axis=-1).astype(np.float32)


@pytest.mark.parametrize("groups", [np.arange(15).reshape(5, 3).tolist(), None])
def test_replicas_agree_on_tests_and_moves_of_exchangeable_blocks(
    groups: list[list[int]] | None,
) -> None:
    """Blocks that are declared, and blocks that are found; slots in another order than asked."""
    bench = Bench(soft_disks, soft_disks(np.random.default_rng(0).random((1, 15)))[0])
    first, second = (
        Replica(FIDE(15, bench.target, groups=groups, seed=0, popsize=8, patience=2))
        for _ in range(2)
    )
    seen: set[str] = set()
    while not {"exchange", "removal", "restart"} <= seen or first.optimizer.evaluations < 600:
        assert first.optimizer.evaluations < 5000, seen  # about 300 are enough
        seen.add(first.optimizer.state.moves.stage.value)
        for slot in reversed(range(first.size)):
            x = first.candidate(slot).x
            np.testing.assert_array_equal(second.candidate(slot).x, x)
            result = bench.look(x)
            for replica in (first, second):
                replica.tell(x, *result, generation=replica.generation, slot=slot)
        assert stages(first) == stages(second) and first.generation == second.generation


def test_late_and_altered_count_as_such_and_injected_do_not(bench: Bench) -> None:
    replica = Replica(bench.optimizer(patience=50))
    old = replica.candidate(2).x.copy()
    for slot in range(100, 108):
        bench.told(replica, slot)
    assert replica.generation == 1
    elsewhere = np.full(DIM, 0.25)
    told: list[tuple[Float64, dict[str, Any], Role, int]] = [
        (old, {"generation": 0, "slot": 2}, Role.LATE, 1),
        (elsewhere, {"generation": 1, "slot": 0}, Role.ALTERED, 2),
        (elsewhere, {"generation": 7, "slot": 0}, Role.ALTERED, 3),  # of a clock ahead of ours
        (elsewhere, {}, Role.INJECTED, 3),
    ]
    for x, name, role, counted in told:
        assert replica.tell(x, *bench.look(x), **name) is role
        assert len(replica.optimizer.state.population.told) == counted
    members, _ = replica.optimizer.state.population.members()
    assert [c.off_distribution for c in members] == [True, True, True]  # their steps will be cut


def test_what_was_asked_in_an_earlier_search_is_an_injected_candidate(bench: Bench) -> None:
    replica = Replica(bench.optimizer())
    first, before = stages(replica), replica.candidate(0).x
    while stages(replica) == first:
        for slot in range(replica.size):
            bench.told(replica, slot)
    assert replica.tell(before, *bench.look(before), generation=0, slot=0) is Role.INJECTED


class Blind(ImageGate):
    """A gate on a machine whose rounding says that images do not guide."""

    guided = property(lambda self: False)


def test_others_say_whether_images_guide_the_next_search(bench: Bench) -> None:
    """It is told with when a search is over, so that rounding cannot part replicas."""
    one, parted, following = (Replica(bench.optimizer()) for _ in range(3))
    for other in (parted, following):
        other.optimizer.state.gate.__class__ = Blind
    while one.optimizer.state.searches < 3:
        np.testing.assert_array_equal(one.candidate(0).x, following.candidate(0).x)
        generation = one.generation
        log = []
        for slot in range(one.size):
            x = one.candidate(slot).x.copy()
            log.append((x, *bench.look(x)))
            one.tell(*log[-1], generation=generation, slot=slot)
        over, guided = one.began == one.generation, one.guided
        for slot, entry in enumerate(log):
            following.tell(*entry, generation=generation, slot=slot, over=over, guided=guided)
            if stages(parted) == stages(one):
                parted.tell(*entry, generation=generation, slot=slot, over=over)
        assert stages(following) == stages(one) and following.guided == one.guided
    assert one.guided and stages(parted) != stages(one)
