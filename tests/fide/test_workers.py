"""More workers than a generation needs: each asks as soon as it is free."""

from __future__ import annotations

import heapq

import numpy as np
import pytest

import fide_tasks
from fide_plugins.fide import FIDE
from fide_plugins.search.moves import Stage
from fide_plugins.types import Float32, Float64

from .helpers import TINY, Render, pending_now, sphere
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
    assert (opt.state.moves.stage, opt.state.searches) == (stage, searches)
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
