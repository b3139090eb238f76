"""Which tokens the linear proposer looks at, and that it misses nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins.proposers.feature_buffer import NEGLIGIBLE, FeatureBuffer
from fide_plugins.proposers.linear import LinearProposer
from fide_plugins.types import Float64

T, C, D = 12, 3, 4
STD = np.full(D, 0.1)


def images(x: Float64, moving: list[int], noise: float = 0.0, seed: int = 0) -> Tensor:
    """Tokens (n, T, C) of which some depend on x, and all have noise."""
    rng = np.random.default_rng(1)
    mixing, ground = rng.standard_normal((D, T, C)), rng.random((T, C))
    mixing[:, [t for t in range(T) if t not in moving]] = 0.0
    tokens = ground + np.tensordot(np.sin(3 * x), mixing, axes=1)
    tokens += noise * np.random.default_rng(seed).standard_normal(tokens.shape)
    return torch.tensor(tokens, dtype=torch.float32)


def points(n: int, seed: int = 0) -> Float64:
    return 0.5 + 0.1 * np.random.default_rng(seed).standard_normal((n, D))


def proposers(**options: Any) -> tuple[LinearProposer, LinearProposer]:
    """One that leaves out tokens, and one that does not."""
    settings: dict[str, Any] = {"capacity": 30, "channel_subsets": (1, None), **options}
    return LinearProposer(D, **settings), LinearProposer(D, select=False, **settings)


def propose(proposer: LinearProposer, target: Tensor) -> Float64:
    z = points(6, seed=7)
    return proposer.propose(z, target, np.full(D, 0.5), STD, np.random.default_rng(3))


def used(proposer: LinearProposer) -> list[list[int]]:
    return [np.flatnonzero(view.used).tolist() for view in proposer._buffers]


@pytest.mark.parametrize("pieces", [1, 3, 24])
def test_only_what_varies_is_used_and_proposals_are_the_same(pieces: int) -> None:
    """The target differs from the images everywhere, also where they do not vary."""
    some, every = proposers()
    x, losses = points(24), np.random.default_rng(2).random(24)
    for rows in np.array_split(np.arange(24), pieces):
        for proposer in (some, every):
            proposer.update(x[rows], images(x[rows], [2, 5, 6]), losses[rows], STD)
    assert used(some) == [[2, 5, 6]] * 2 and used(every) == [list(range(T))] * 2
    target = images(points(1, seed=5), [2, 5, 6])[0] + 0.3
    np.testing.assert_allclose(propose(some, target), propose(every, target), rtol=0, atol=1e-6)


def test_what_begins_to_vary_is_taken_up_at_once() -> None:
    some, every = proposers()
    target = images(points(1, seed=5), [1, 2, 3])[0]
    for step, moving in enumerate([[1], [1, 2], [3]]):
        x, losses = points(10, seed=step), np.random.default_rng(step).random(10)
        for proposer in (some, every):
            proposer.update(x, images(x, moving), losses, STD)
        np.testing.assert_allclose(propose(some, target), propose(every, target), atol=1e-6)
    assert used(some) == [[1, 2, 3]] * 2


def test_what_varies_no_more_is_left_out_and_may_come_back_elsewhere() -> None:
    """A part settles at a place far from where it was when the search began, then moves again."""
    some, every = proposers(capacity=12)
    seen = []
    for step, moving in enumerate([[0, 4, 8, 9]] * 2 + [[0]] * 4 + [[0, 4]] * 3):
        x, losses = points(6, seed=step), np.random.default_rng(step).random(6)
        tokens = images(x, moving)
        tokens[:, 8] += 0.5 if step >= 2 else 0.0
        for proposer in (some, every):
            proposer.update(x, tokens, losses, STD)
        seen.append(used(some)[1])
        target = images(points(1, seed=50), [0, 4])[0]
        if some.ready:
            np.testing.assert_allclose(propose(some, target), propose(every, target), atol=1e-6)
    assert seen[1] == [0, 4, 8, 9] and seen[5] == [0] and seen[-1] == [0, 4]
    view = some._buffers[1]
    gram = every._buffers[1].gram
    centered = [g - g.mean(0) - g.mean(0)[:, None] + g.mean() for g in (view.gram, gram)]
    np.testing.assert_allclose(centered[0], centered[1], atol=1e-6 * np.abs(gram).max())
    assert view.features.shape == (12, 2 * C)


def test_no_product_changes_by_more_than_is_said() -> None:
    """Noise in every token: the least of them go as long as they are negligible together."""
    x = points(30)
    tokens = images(x, [2, 3], noise=2e-5)
    some, every = FeatureBuffer(None), FeatureBuffer(None, select=False)
    for view in (some, every):
        view.add(tokens, 30)
    assert 2 <= some.used.sum() < T
    target = images(points(1, seed=5), [2, 3])[0] + 0.5
    sources = np.arange(3)
    ours, theirs = (view.toward(target)[1] - view.gram[sources] for view in (some, every))
    scale = np.sqrt(np.trace(every.gram) * float((target - tokens.mean(0)).square().sum()))
    assert np.abs(ours - theirs).max() < np.sqrt(NEGLIGIBLE) * scale


def test_images_that_are_all_the_same() -> None:
    some, _ = proposers()
    x = points(10)
    some.update(x, images(x, []), np.arange(10.0), STD)
    assert used(some) == [[], []]
    target = images(x, [])[0] + 1
    assert np.isfinite(propose(some, target)).all()
    moved = images(points(5, seed=1), [7])
    some.update(points(5, seed=1), moved, np.arange(5.0), STD)
    assert used(some) == [[7], [7]]
