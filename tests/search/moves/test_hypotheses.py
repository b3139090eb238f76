"""How wide a search begins that a learned model starts."""

from __future__ import annotations

import numpy as np
import torch

from fide_plugins import Float, Group, Space
from fide_plugins.search.mixed import Axes
from fide_plugins.search.policy import MovePolicy
from fide_plugins.types import Float64, Posterior

SPACE = Space(
    hand=Float(0, 360, periodic=True),
    lamps=3 * Group(x=Float(0, 1), hue=Float(0, 1, periodic=True)),
)
AXES = Axes(SPACE.dim, SPACE.layout)
TRUTH = np.array([0.001, 0.1, 0.999, 0.5, 0.5, 0.9, 0.002])  # hand, then x and hue of each lamp


def begin(hypotheses: Float64) -> Float64:
    """Standard deviations (d,) of the first search."""
    d = SPACE.dim
    policy = MovePolicy(
        np.full(d, 0.5), np.full(d, 1 / 6), 9, torch.zeros(1, 3), 3, 0,
        SPACE.largest_family, AXES, Posterior(hypotheses),
    )  # fmt: skip
    assert policy.hypotheses is not None
    policy.hypotheses.learn([(0.0, TRUTH)], TRUTH, policy.known.exchangeability.distance)
    return policy.hypotheses.next(policy.known, policy.start).std


def test_the_spread_goes_around_circles_and_knows_lamps_in_any_order() -> None:
    rng = np.random.default_rng(0)
    around = np.mod(TRUTH + 0.03 * rng.standard_normal((512, 7)), 1.0)
    around[:, 1::2] = np.clip(TRUTH[1::2] + 0.03 * rng.standard_normal((512, 3)), 0, 1)
    lamps = around[:, 1:].reshape(512, 3, 2)
    shuffled = np.stack([lamp[rng.permutation(3)] for lamp in lamps]).reshape(512, 6)
    spread = begin(np.column_stack([around[:, 0], shuffled]))
    assert spread.max() < 0.04  # the hypotheses around it have 0.03
    np.testing.assert_allclose(spread, begin(around), rtol=1e-12)


def test_of_sets_few_are_rendered_and_one_is_searched_narrowly() -> None:
    rng = np.random.default_rng(0)
    x = rng.random((512, SPACE.dim))  # as wide as can be
    policies = [
        MovePolicy(
            np.full(7, 0.5), np.full(7, 1 / 6), 9, torch.zeros(1, 3), 3, 0,
            groups, AXES, Posterior(x),
        )
        for groups in (SPACE.largest_family, [])
    ]  # fmt: skip
    rendered = [len(policy.draw(rng)) for policy in policies]
    assert rendered[0] < rendered[1] / 2
    stds, waiting = [], []
    for policy in policies:
        assert policy.hypotheses is not None
        found = [(float(i), row) for i, row in enumerate(policy.draw(rng))]
        policy.hypotheses.learn(found, found[0][1], policy.known.exchangeability.distance)
        stds.append(policy.hypotheses.next(policy.known, policy.start).std.max())
        waiting.append(policy.hypotheses.waiting)
    assert waiting == [False, True]
    assert stds[0] < stds[1] / 2


def refined_policy(draws: Float64, refined: Float64) -> MovePolicy:
    return MovePolicy(
        np.full(7, 0.5), np.full(7, 1 / 6), 9, torch.zeros(1, 3), 3, 0,
        SPACE.largest_family, AXES, Posterior(draws, refined),
    )  # fmt: skip
