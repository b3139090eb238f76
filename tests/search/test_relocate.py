"""Where to go on when a search has stalled."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from fide_plugins.points import Float64
from fide_plugins.rendered import Rendered
from fide_plugins.search.relocate import Relocation, Stage

DIM = 6  # three things of two parameters: place is even, brightness odd
THINGS = [[0, 1], [2, 3], [4, 5]]


def tokens(x: Float64) -> torch.Tensor:
    """Three patches for each thing: (9, 4), of which the last channel is noise."""
    patches = np.zeros((9, 4))
    for thing in range(3):
        place, brightness = x[2 * thing], x[2 * thing + 1]
        patches[3 * thing : 3 * thing + 3, :3] = (1 + brightness) * (1 + place)
    patches[:, 3] = np.random.default_rng(int(1e6 * x.sum())).random(9) * 100
    return torch.as_tensor(patches, dtype=torch.float32)


def rendered(x: Float64, loss: float = 1.0, index: int = 0) -> Rendered:
    return Rendered(index, x, tokens(x), loss)


def stalled(loss: float = 1.0, renders: int = 100) -> Relocation:
    relocation = Relocation(DIM, 1 / 6, 8, channels=3)
    assert relocation.after_search(rendered(np.full(DIM, 0.25), loss), renders) is Stage.PROBE
    return relocation


def probed(relocation: Relocation, seed: int = 0) -> Relocation:
    x = relocation.draw_probes(np.random.default_rng(seed))
    relocation.learn_parts([rendered(row) for row in x])
    return relocation


def sets(relocation: Relocation) -> list[list[int]]:
    return sorted(part.tolist() for part in relocation.parts)


def test_without_an_image_the_next_search_knows_nothing() -> None:
    relocation = Relocation(DIM, 1 / 6, 8, None)
    for _ in range(3):
        assert relocation.after_search(None, 100) is Stage.SEARCH
        assert relocation.goal == np.inf


def test_probes_move_one_parameter_each() -> None:
    relocation = stalled()
    x = relocation.draw_probes(np.random.default_rng(0))
    moved = x != 0.25
    np.testing.assert_array_equal(moved, np.eye(DIM, dtype=bool))
    assert x.min() >= 0 and x.max() <= 1


def test_parts_are_learned_from_one_round() -> None:
    for seed in range(10):
        assert sets(probed(stalled(), seed)) == THINGS


def test_what_is_no_probe_and_what_is_missing_does_no_harm() -> None:
    relocation = stalled()
    x = relocation.draw_probes(np.random.default_rng(0))
    strangers = [rendered(np.full(DIM, 0.25)), rendered(np.full(DIM, 0.9))]
    relocation.learn_parts([rendered(row) for row in x[:4]] + strangers)
    assert sets(relocation)[:2] == THINGS[:2]
    relocation.learn_parts([])
    assert sets(relocation)[:2] == THINGS[:2]
    probed(relocation, 1)
    assert sets(relocation) == THINGS


def test_each_scout_moves_one_part_and_parts_are_drawn_by_size() -> None:
    relocation = Relocation(DIM, 1 / 6, 30_000, channels=3)
    relocation.after_search(rendered(np.full(DIM, 0.25)), 100)
    relocation.learn_parts([rendered(x) for x in relocation.draw_probes(np.random.default_rng(0))])
    x = relocation.draw_scouts(np.random.default_rng(1))
    assert x.shape == (30_000, DIM) and x.min() >= 0 and x.max() <= 1
    moved = np.unique(x != 0.25, axis=0, return_counts=True)
    expected = np.zeros((3, DIM), bool)
    for row, thing in zip(expected, THINGS, strict=True):
        row[thing] = True
    np.testing.assert_array_equal(moved[0], expected[::-1])
    assert abs(moved[1] - 10_000).max() < 400  # five standard deviations
    values = x[x[:, 0] != 0.25][:, :2]
    assert np.abs(values.mean(axis=0) - 0.5).max() < 0.02  # uniform
    assert np.abs(values.std(axis=0) - np.sqrt(1 / 12)).max() < 0.02


def test_a_small_population_has_twenty_scouts() -> None:
    assert Relocation(DIM, 1 / 6, 4, None).scouts == 20


def test_the_search_from_a_scout_is_wide_where_it_moved() -> None:
    relocation = probed(stalled())
    scout = np.full(DIM, 0.25)
    scout[2:4] = 0.7, 0.1
    mean, std = relocation.begin_at(scout)
    np.testing.assert_array_equal(mean, scout)
    np.testing.assert_allclose(std, [1 / 48, 1 / 48, 1 / 12, 1 / 12, 1 / 48, 1 / 48])


def test_a_winner_is_relocated_next() -> None:
    relocation = probed(stalled(1.0))
    assert relocation.goal == 1.0
    winner = rendered(np.full(DIM, 0.5), 0.5)
    assert relocation.after_search(winner, 50) is Stage.SCOUT  # its parts are known
    assert relocation.incumbent is winner and relocation.goal == 0.5


def test_after_failures_that_cost_too_much_the_next_search_knows_nothing() -> None:
    relocation = probed(stalled(1.0, renders=100))
    worse = rendered(np.full(DIM, 0.5), 2.0)
    outcomes = [relocation.after_search(worse, 50) for _ in range(5)]
    assert outcomes == [Stage.SCOUT, Stage.SCOUT, Stage.PROBE, Stage.SCOUT, Stage.SEARCH]
    assert relocation.goal == np.inf
    assert sets(relocation) == THINGS, "what belongs together is still known"


def test_a_success_pays_for_more_failures() -> None:
    relocation = stalled(1.0, renders=100)
    worse, better = rendered(np.full(DIM, 0.5), 2.0), rendered(np.full(DIM, 0.6), 0.5)
    stages = [relocation.after_search(found, 60) for found in [worse] * 3 + [better] + [worse] * 4]
    assert Stage.SEARCH not in stages[:-1]
    assert stages[-1] is Stage.SEARCH


def test_probes_are_repeated_where_scouts_fail_but_not_for_ever() -> None:
    relocation = probed(stalled(renders=10**9))
    worse = rendered(np.full(DIM, 0.5), 2.0)
    stages = []
    for _ in range(30):
        stages.append(relocation.after_search(worse, 1))
        if stages[-1] is Stage.PROBE:
            probed(relocation)
    assert [i for i, stage in enumerate(stages) if stage is Stage.PROBE] == [2, 5, 8]


def test_state_goes_on() -> None:
    original = probed(stalled())
    original.after_search(rendered(np.full(DIM, 0.5), 2.0), 50)
    copy = Relocation(DIM, 1 / 6, 8, channels=3)
    copy.load_state_dict(original.state_dict())
    outcomes: list[Callable[[Relocation], object]] = [
        lambda r: r.draw_scouts(np.random.default_rng(3)).tolist(),
        lambda r: r.after_search(rendered(np.full(DIM, 0.5), 2.0), 160),
        lambda r: r.goal,
    ]
    for outcome in outcomes:
        assert outcome(original) == outcome(copy)
