"""What each move proposes, and where its search begins."""

from __future__ import annotations

import numpy as np

from fide_plugins.population import TrainingSample
from fide_plugins.search.mixed import Axes
from fide_plugins.search.moves import (
    HalfTurn,
    Known,
    RandomRestart,
    Rearrange,
    RelocateGroup,
    RelocateSegment,
    Split,
    Stage,
    segment,
)
from fide_plugins.search.scene import Exchangeability, Sensitivity
from fide_plugins.types import Float64

from ..conftest import brightest, sample

BLOCKS = np.arange(8).reshape(4, 2)
SIGMA0 = np.full(8, 1 / 6)


def loss(image: Float64, target: Float64) -> float:
    return float(np.square(image - target).mean())


def scene(x: Float64, x_star: Float64, *, exchangeable: bool = True) -> Known:
    """Four bumps on a line, the brightest of which is seen, once a search ended at x."""
    target = brightest(x_star, BLOCKS)
    known = Known(
        x0=np.full(8, 0.5),
        sigma0=SIGMA0,
        target=sample(target, x_star).tokens,
        channels=3,
        exchangeability=Exchangeability(Axes(8), 3, BLOCKS.tolist() if exchangeable else []),
        sensitivity=Sensitivity(Axes(8), 3),
        axes=Axes(8),
    )
    known.incumbent = rendered(known, x, x_star)
    known.optima.note(known.incumbent, known.exchangeability.distance)
    return known


def rendered(known: Known, x: Float64, x_star: Float64) -> TrainingSample:
    image = brightest(x, BLOCKS)
    return sample(image, x, loss(image, brightest(x_star, BLOCKS)))


def removed(known: Known, x_star: Float64, rng: np.random.Generator) -> Known:
    X = known.removal.draw(known.current.x, BLOCKS, rng)
    known.removal.learn(known.current, [rendered(known, x, x_star) for x in X], BLOCKS, 3)
    return known


# Things at 0.1, 0.4, 0.6, 0.9; the optimum has two dim ones at 0.1 and one for those in the middle.
STAR = np.array([0.1, 0.8, 0.4, 0.8, 0.6, 0.8, 0.9, 0.8])
STALLED = np.array([0.1, 0.7, 0.5, 0.8, 0.1, 0.0, 0.9, 0.8])


def test_removal_says_what_each_block_is_worth(rng: np.random.Generator) -> None:
    known = scene(STALLED, STAR)
    X = known.removal.draw(STALLED, BLOCKS, rng)
    for i, x in enumerate(X):
        others = np.delete(np.arange(8), BLOCKS[i])
        np.testing.assert_array_equal(x[others], STALLED[others])
        assert any((x[BLOCKS[i]] == STALLED[b]).all() for j, b in enumerate(BLOCKS) if j != i)
    removed(known, STAR, rng)
    assert int(np.argmin(known.removal.costs)) == 2
    where = (np.arange(16) + 0.5) / 16
    for i in (0, 1, 3):
        assert abs(where[known.removal.owned[i].argmax()] - STALLED[2 * i]) < 0.5
    residual = known.removal.residual(known.current, known.target, 3)
    assert int(np.argmax(residual)) == 1, "the one in the middle stands for two"


def test_split_puts_the_redundant_block_beside_the_overloaded_one(
    rng: np.random.Generator,
) -> None:
    known = removed(scene(STALLED, STAR), STAR, rng)
    x = Split().draw(known, 4000, rng)
    assert x.shape == (4000, 8) and x.min() >= 0 and x.max() <= 1
    moved = (x != STALLED).reshape(-1, 4, 2).any(axis=2)
    assert (moved.sum(axis=1) == 1).all(), "one donor each"
    counts = moved.sum(axis=0) / 4000
    expected = np.exp(-np.arange(4.0))
    np.testing.assert_allclose(np.sort(counts)[::-1], expected / expected.sum(), atol=0.03)
    assert counts.argmax() == 2
    beside = np.abs(x[moved[:, 2], 4] - 0.5) < 0.2
    assert beside.mean() > 0.5
    scores = [rendered(known, row, STAR).loss for row in x[:200]]
    assert min(scores) < known.current.loss
    start = Split().begin_at(known, x[0])
    wide = np.isin(start.std, 1 / 12)
    np.testing.assert_array_equal(wide, x[0] != STALLED)
    np.testing.assert_allclose(start.std[~wide], 1 / 48)


def test_groups_are_found_by_sensitivity(rng: np.random.Generator) -> None:
    known = scene(np.array([0.1, 0.7, 0.4, 0.8, 0.6, 0.6, 0.9, 0.8]), STAR, exchangeable=False)
    assert RelocateGroup().needs(known) is Stage.SENSITIVITY
    for _ in range(4):
        X = known.sensitivity.draw(known.current.x, rng)
        np.testing.assert_array_equal(known.current.x != X, np.eye(8, dtype=bool))
        known.sensitivity.learn(known.current, [rendered(known, x, STAR) for x in X])
    assert RelocateGroup().needs(known) is None
    assert sorted(group.tolist() for group in known.sensitivity.groups) == BLOCKS.tolist()
    known.sensitivity.learn(known.current, [rendered(known, rng.random(8), STAR)])
    assert len(known.sensitivity.groups) == 4


def test_segments_are_neighbors_of_any_length(rng: np.random.Generator) -> None:
    drawn = [segment(7, rng) for _ in range(5000)]
    lengths = np.array([len(one) for one in drawn])
    assert set(lengths) == {1, 2, 3}
    assert all((np.diff(one) == 1).all() for one in drawn)
    touched = np.bincount(np.concatenate(drawn), minlength=7)
    assert touched.min() > 500
    assert segment(2, rng).tolist() in ([0], [1])
    known = scene(STALLED, STAR, exchangeable=False)
    x = RelocateSegment().draw(known, 50, rng)
    assert ((x != STALLED).any(axis=1)).all()
    assert not RelocateSegment().possible(scene(STALLED, STAR))


def test_neighbors_are_turned_and_mirrored_by_turns(rng: np.random.Generator) -> None:
    assert not HalfTurn().possible(scene(STALLED, STAR)), "blocks tell what belongs together"
    known = scene(np.full(8, 0.3), STAR, exchangeable=False)
    assert HalfTurn().possible(known)
    kinds = set()
    for x in HalfTurn().draw(known, 2000, rng):
        changed = np.flatnonzero(x != 0.3)
        turned = (x[changed] >= 0.8) & (x[changed] <= 0.88)
        mirrored = x[changed] == 0.7
        assert (turned ^ mirrored).all()
        assert len(changed) <= 3 and np.ptp(changed) == len(changed) - 1, "neighbors"
        kinds.add("".join(np.where(turned, "t", "m").tolist()))
    assert kinds == {"t", "m", "tm", "mt", "tmt"}


def test_parts_of_a_chain_are_reordered_or_replaced(rng: np.random.Generator) -> None:
    values = np.arange(1, 9) / 10
    known = scene(values, STAR, exchangeable=False)
    assert not Rearrange().possible(known)
    known.exchangeability.chain = BLOCKS
    assert Rearrange().possible(known)
    X = Rearrange().draw(known, 1000, rng)
    parts = {tuple(np.rint(10 * x).astype(int).tolist()) for x in X if set(x) == set(values)}
    assert (7, 8, 5, 6, 3, 4, 1, 2) in parts, "reversed"
    assert (3, 4, 1, 2, 5, 6, 7, 8) in parts, "two are exchanged"
    assert (5, 6, 7, 8, 1, 2, 3, 4) in parts, "rotated"
    assert all(part[0] % 2 and part[0] + 1 == part[1] for part in parts), "parts stay whole"
    assert min(len(set(x) & set(values)) for x in X) == 6, "at most one part is new"


def test_new_searches_begin_in_different_places(rng: np.random.Generator) -> None:
    known = scene(STALLED, STAR)
    x = RandomRestart().draw(known, 20_000, rng)
    assert np.abs(x.mean(axis=0) - 0.5).max() < 0.02
    assert np.abs(x.std(axis=0) - np.sqrt(1 / 12)).max() < 0.01
    starts = [RandomRestart().start_without_images(known, i, rng) for i in range(1, 20)]
    assert len({tuple(start.mean) for start in starts}) == 19
    assert [start.population for start in starts[::2]] == [2, 4, 8, 16, 32, 64, 64, 64, 64, 64]
    assert all(start.population == 1 for start in starts[1::2])
    assert all((start.std <= SIGMA0).all() for start in starts)
    for start in starts:  # which may all become as wide as the first search
        np.testing.assert_allclose(start.widest * start.std, SIGMA0)
