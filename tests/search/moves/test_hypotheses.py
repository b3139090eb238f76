"""How wide a search begins that a learned model starts."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fide_plugins import Choice, Float, Group, Int, Space
from fide_plugins.search.hypotheses import Hypotheses
from fide_plugins.search.policy import MovePolicy
from fide_plugins.types import Float64, Posterior

SPACE = Space(
    hand=Float(0, 360, periodic=True),
    lamps=3 * Group(x=Float(0, 1), hue=Float(0, 1, periodic=True)),
)
TRUTH = np.array([0.001, 0.1, 0.999, 0.5, 0.5, 0.9, 0.002])  # hand, then x and hue of each lamp


def begin(hypotheses: Float64) -> Float64:
    """Standard deviations (d,) of the first search."""
    d = SPACE.dim
    policy = MovePolicy(
        np.full(d, 0.5), np.full(d, 1 / 6), 9, torch.zeros(1, 3), 3, 0,
        SPACE.largest_family, SPACE.layout, Posterior(hypotheses),
    )  # fmt: skip
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
            groups, SPACE.layout, Posterior(x),
        )
        for groups in (SPACE.largest_family, [])
    ]  # fmt: skip
    rendered = [len(policy.draw(rng)) for policy in policies]
    assert rendered[0] < rendered[1] / 2
    stds, waiting = [], []
    for policy in policies:
        found = [(float(i), row) for i, row in enumerate(policy.draw(rng))]
        policy.hypotheses.learn(found, found[0][1], policy.known.exchangeability.distance)
        stds.append(policy.hypotheses.next(policy.known, policy.start).std.max())
        waiting.append(policy.hypotheses.waiting)
    assert waiting == [False, True]
    assert stds[0] < stds[1] / 2


@pytest.mark.parametrize(
    ("losses", "above"), [([1.0, 2.0, 3.0], 0.2), ([-5.0] * 3, None), ([1.0, np.inf, np.inf], None)]
)
def test_a_search_has_to_be_quick_only_above_a_positive_finite_loss(
    losses: list[float], above: float | None
) -> None:
    hypotheses = Hypotheses(Posterior(np.random.default_rng(0).random((10, 2))), 2)
    found = [(loss, x) for loss, x in zip(losses, hypotheses.x, strict=False)]
    hypotheses.learn(found, hypotheses.x[0], lambda x, y: float(np.abs(x - y).max()))
    assert hypotheses.strict_above == pytest.approx(above)
    again = Hypotheses(None, 2)
    again.load_state_dict(hypotheses.state_dict())  # which refuses what is not finite
    assert again.typical == hypotheses.typical


def refined_policy(draws: Float64, refined: Float64) -> MovePolicy:
    return MovePolicy(
        np.full(7, 0.5), np.full(7, 1 / 6), 9, torch.zeros(1, 3), 3, 0,
        SPACE.largest_family, SPACE.layout, Posterior(draws, refined),
    )  # fmt: skip


def test_what_was_refined_is_rendered_first_and_searched_narrowly() -> None:
    rng = np.random.default_rng(0)
    draws, refined = rng.random((512, 7)), np.tile(TRUTH, (8, 1))
    policy = refined_policy(draws, refined)
    there, first = policy.hypotheses, np.concatenate([refined[:5], draws[:3]])
    np.testing.assert_array_equal(policy.draw(rng), first)
    there.learn([(1.0, TRUTH)], TRUTH, policy.known.exchangeability.distance)
    assert there.next(policy.known, policy.start).std.max() < 0.01
    assert begin(np.tile(TRUTH, (512, 1))).min() == 0.02  # a density may be wrong by as much

    again = Hypotheses(None, 7, sets=True)
    again.load_state_dict(there.state_dict())
    np.testing.assert_array_equal(again.draw(policy.known, 20, rng), first)
    np.testing.assert_array_equal(again.x, draws)
    again.begin(None)
    assert not len(again.draw(policy.known, 20, rng))


def test_where_the_emulator_was_wrong_the_search_begins_as_wide_as_the_draws() -> None:
    """The middle of the draws has the lowest loss: descents have ended far from the answer."""
    rng = np.random.default_rng(0)
    draws = np.clip(TRUTH + 0.05 * rng.standard_normal((512, 7)), 0, 1)
    draws[0] = TRUTH
    policy = refined_policy(draws, rng.random((8, 7)))
    without = refined_policy(draws, np.empty((0, 7)))
    for one in (policy, without):
        found = [(float(not np.array_equal(x, TRUTH)), x) for x in one.draw(rng)]
        one.hypotheses.learn(found, TRUTH, one.known.exchangeability.distance)
    starts = [one.hypotheses.next(one.known, one.start) for one in (policy, without)]
    np.testing.assert_array_equal(starts[0].mean, TRUTH)
    np.testing.assert_array_equal(starts[0].std, starts[1].std)


@pytest.mark.parametrize("blocks", [True, False])
def test_draws_alone_say_what_a_typical_loss_is(blocks: bool) -> None:
    """Whatever was refined, and where integers and choices are rendered in the middle of cells."""
    space = Space(sky=Choice("day", "night"), lamps=2 * Group(x=Float(0, 1), n=Int(0, 3)))
    rng, groups = np.random.default_rng(0), space.largest_family if blocks else []
    draws, refined = rng.random((512, space.dim)), rng.random((6, space.dim))
    policy = MovePolicy(
        np.full(space.dim, 0.5), np.full(space.dim, 1 / 6), 9, torch.zeros(1, 3), 3, 0,
        groups, space.layout, Posterior(draws, refined),
    )  # fmt: skip
    rendered = space.layout.snap(policy.draw(rng))
    assert len(rendered) == 8
    losses = [1e-6] * 5 + [0.3, 0.2, 9.0]
    distance = policy.known.exchangeability.distance
    policy.hypotheses.learn(list(zip(losses, rendered, strict=True)), rendered[0], distance)
    assert policy.hypotheses.typical == 0.3
    assert policy.hypotheses.strict_above == pytest.approx(0.03)
    of_refined = list(zip(losses, rendered, strict=True))[:5]  # the others have failed
    policy.hypotheses.learn(of_refined, rendered[0], distance)
    assert policy.hypotheses.typical is None
