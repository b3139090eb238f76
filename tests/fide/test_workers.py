"""More workers than a generation needs: each asks as soon as it is free."""

from __future__ import annotations

import heapq
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fide_tasks
from fide_plugins.fide import FIDE
from fide_plugins.search.policy import Stage
from fide_plugins.space import Float, Int, Space
from fide_plugins.types import Float32, Float64

from .helpers import TINY, Render, StateOf, pending_now, sphere
from .test_moves import settings, until

WORKERS = 8
TESTS = [Stage.EXCHANGE, Stage.SENSITIVITY, Stage.REMOVAL]


class Workers:
    """Eight of them, on a clock of their own: a render takes a second, give or take a half."""

    def __init__(self, opt: FIDE, render: Render, seed: int = 0) -> None:
        self.opt, self.render = opt, render
        self._rng, self._now = np.random.default_rng(seed), 0.0
        self.out: list[tuple[float, int, Float64]] = []

    def step(self) -> None:
        """Keep all busy, and tell the result that is due first."""
        while len(self.out) < WORKERS:
            due = self._now + self._rng.uniform(0.5, 1.5)
            heapq.heappush(self.out, (due, self.opt.state.population.drawn, self.opt.ask(1)[0]))
        self._now, _, x = heapq.heappop(self.out)
        self.opt.tell(x[None], self.render(x[None]))


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [0, 1])
def test_exchangeable_blocks_are_found(seed: int) -> None:
    """The cells of a Voronoi diagram, each the five parameters of one."""
    task = fide_tasks.make("voronoi", 64, seed, cells=5)
    workers = Workers(FIDE(task.dim, task.target, seed=seed), task.render)
    moves = workers.opt.state.moves
    while not moves.known.exchangeability.finished:
        workers.step()
        assert workers.opt.evaluations < 3000
    np.testing.assert_array_equal(moves.known.exchangeability.blocks, np.arange(25).reshape(5, 5))


@pytest.mark.parametrize("seed", range(4))
def test_noise_is_measured_where_groups_are_declared(
    seed: int, target: Float32, render: Render
) -> None:
    """By two renders of the local optimum, while six other workers render something else."""
    noise = np.random.default_rng(seed)

    def noisy(X: Float64) -> Float32:
        images = render(X)
        grain = 0.01 * noise.standard_normal(images.shape)
        return np.clip(images + grain, 0, 1).astype(np.float32)

    groups: dict[str, Any] = {"groups": [[0, 1, 2], [3, 4, 5]]}
    opt = until(Stage.EXCHANGE, target, noisy, **groups)
    workers = Workers(opt, noisy, seed)
    while opt.state.stage is Stage.EXCHANGE:
        workers.step()
    assert opt.state.moves.noise is not None and opt.state.moves.noise > 0


@pytest.mark.parametrize("stage", TESTS)
def test_a_test_waits_for_its_own_candidates(stage: Stage, target: Float32, render: Render) -> None:
    opt = until(stage, target, render, **settings(stage))
    before, searches = opt.evaluations, opt.state.searches
    own, extra = opt.ask(), opt.ask(3)
    assert not any((x == own).all(axis=1).any() for x in extra)
    generations = opt.state.population.generations
    opt.tell(extra, render(extra))
    opt.tell(own[1:], render(own[1:]))
    assert opt.state.population.generations == generations
    assert (opt.state.stage, opt.state.searches) == (stage, searches)
    opt.tell(own[:1], render(own[:1]))
    assert opt.state.population.generations == generations + 1
    assert opt.evaluations == before + len(own) + 3


@pytest.mark.parametrize("stage", TESTS)
@pytest.mark.parametrize("withdrawn", [False, True])
def test_lost_candidates_stop_nothing(
    stage: Stage, withdrawn: bool, target: Float32, render: Render
) -> None:
    """Renders that fail are withdrawn; those of a worker that was killed never come back."""
    opt = until(stage, target, render, **settings(stage))
    generations = opt.state.population.generations
    own = opt.ask()
    if withdrawn:
        opt.withdraw(own)
    for _ in range(len(own) if withdrawn else 2 * len(own)):
        assert opt.state.population.generations == generations
        x = opt.ask(1)
        opt.tell(x, render(x))
    assert opt.state.population.generations == generations + 1


@pytest.mark.parametrize("stage", TESTS)
@pytest.mark.parametrize("every", [False, True])
def test_a_test_with_failures_is_not_asked_again(
    stage: Stage, every: bool, target: Float32, render: Render
) -> None:
    """As many others are asked as failed, and they complete it, also where all of them failed."""
    opt = until(stage, target, render, **settings(stage))
    generations = opt.state.population.generations
    own = opt.ask()
    failed = len(own) if every else 1
    opt.withdraw(own[:failed])
    if not every:
        opt.tell(own[1:], render(own[1:]))
    assert opt.state.population.generations == generations
    others = opt.ask()
    assert len(others) == failed and not any((own == x).all(axis=1).any() for x in others)
    opt.tell(others, render(others))
    assert opt.state.population.generations == generations + 1


def test_a_value_that_cannot_be_rendered_is_not_asked_for_ever(target: Float32) -> None:
    """It is among the values that were searched least often, and soon alone."""
    space, rng = Space(x=Float(0, 1), y=Float(0, 1), n=Int(1, 4)), np.random.default_rng(0)
    height, width = target.shape[:2]
    picture = rng.random((height, width, 3)).astype(np.float32)
    opt = FIDE(space, target, seed=0, popsize=6, patience=1)
    failed = [0]
    while opt.evaluations < 700:
        [x] = opt.ask(1)
        p = space.decode(x)
        if p["n"] == 4:
            opt.withdraw(x[None])
            failed[-1] += 1
            assert failed[-1] < 40, "one after the other"
        else:
            opt.tell(x[None], [np.clip(picture * p["x"] + 0.1 * p["n"] * p["y"], 0, 1)])
            failed += [0] * (failed[-1] > 0)
    assert opt.state.searches > 3 and len(failed) > 3


@pytest.mark.parametrize("stage", TESTS)
def test_saved_while_extra_candidates_are_out(
    stage: Stage, target: Float32, render: Render, state_of: StateOf, tmp_path: Path
) -> None:
    original = until(stage, target, render, **settings(stage))
    own, extra = original.ask(), original.ask(3)
    for X in (own[:1], extra[:2]):
        original.tell(X, render(X))
    original.withdraw(own[1:2])
    original.save(tmp_path / "c")
    copy = FIDE.load(tmp_path / "c")
    for opt in (original, copy):
        opt.tell(extra[2:], render(extra[2:]))
        opt.tell(own[2:], render(own[2:]))
        workers = Workers(opt, render)
        for _ in range(40):
            workers.step()
    assert state_of(copy) == state_of(original)


def test_restart_candidates_stand_for_each_other(target: Float32, render: Render) -> None:
    """Who has nothing to render gets more of them, and the first that are told are enough."""
    opt = until(Stage.RESTART, target, render)
    first, more = opt.ask(), opt.ask(9)
    assert not all((x == first).all(axis=1).any() for x in more)  # a half turn may come twice
    X = np.concatenate([more, first[: len(first) - 9]])
    opt.tell(X, render(X))
    assert opt.state.stage is Stage.SEARCH


def test_what_the_generation_does_not_need_is_drawn_for_the_next_one() -> None:
    """Once what is out completes it, and half of it is known: around where the mean will be."""
    opt = FIDE(3, TINY, popsize=8, sigma0=0.02, seed=0)
    X = opt.ask(6)
    opt.tell(X[:4], None, sphere(X[:4]))
    needed, mean = opt.ask(2), opt.state.search.mean.copy()
    ahead = opt.ask(4000)
    assert [c.off_distribution for c in pending_now(opt)] == [False] * 4 + [True] * 4000
    expected = opt.state.search.preview(*opt.state.population.members())
    error = ahead.mean(axis=0) - expected.mean
    assert np.abs(error).max() < 5 * expected.std.max() / 4000**0.5
    assert np.linalg.norm(expected.mean - mean) > 10 * np.linalg.norm(error)
    np.testing.assert_array_equal(opt.state.search.mean, mean)
    opt.tell(needed, None, sphere(needed))
    opt.tell(X[4:], None, sphere(X[4:]))
    assert opt.state.population.generations == 1 and pending_now(opt)


def test_one_worker_gets_nothing_ahead(target: Float32, render: Render) -> None:
    opt = FIDE(6, target, popsize=8, seed=0)
    for _ in range(100):
        x = opt.ask(1)
        assert not pending_now(opt)[0].off_distribution
        opt.tell(x, render(x))


def test_as_many_are_proposed_as_by_one_worker(target: Float32, render: Render) -> None:
    """Proposals are the last of a generation: with eight workers nearly all are made ahead."""
    opt = FIDE(
        6, target, seed=0, popsize=10, proposal_fraction=0.5, fraction_rate=0.0,
        guard_images=False, restarts="none", proposer="linear",
    )  # fmt: skip
    workers, asked = Workers(opt, render), {}
    for step in range(400):
        workers.step()
        if step >= 100:
            asked.update({c.index: c for c in pending_now(opt)})
    ahead = [c for c in asked.values() if c.off_distribution]
    assert len(ahead) > 0.4 * len(asked)
    assert 0.4 < np.mean([c.proposed for c in asked.values()]) < 0.6
    assert np.mean([c.proposed for c in ahead]) > 0.5
