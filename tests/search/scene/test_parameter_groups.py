"""Which parameters belong together."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins.search.scene import find_parts, overlaps
from fide_plugins.types import Float64


def blocks(sizes: list[int], patches: int = 20, seed: int = 0) -> tuple[Float64, list[list[int]]]:
    """Changes of things in places of their own, their parameters in random order."""
    rng = np.random.default_rng(seed)
    n = sum(sizes)
    order = rng.permutation(n)
    changes = np.zeros((n, patches * len(sizes)))
    parts, start = [], 0
    for place, size in enumerate(sizes):
        members = order[start : start + size]
        columns = slice(place * patches, (place + 1) * patches)
        changes[members, columns] = rng.random((size, 1)) * rng.uniform(0.5, 1, (size, patches))
        parts.append(sorted(members.tolist()))
        start += size
    return changes, sorted(parts)


def found(changes: Float64) -> list[list[int]]:
    return sorted(part.tolist() for part in find_parts(overlaps(changes)))


def test_overlap_of_known_rows() -> None:
    rows = np.array([[4.0, 2.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [0.0, 1.0, 3.0, 0.0], [0.0] * 4])
    expected = np.array(
        [[1, 1, 1 / 4, 0], [1, 1, 1 / 2, 0], [1 / 4, 1 / 2, 1, 0], [0, 0, 0, 0]], np.float64
    )
    with np.errstate(all="raise"):
        np.testing.assert_allclose(overlaps(rows), expected, rtol=1e-15)
        np.testing.assert_allclose(overlaps(1e-200 * rows), expected, rtol=1e-12)


@pytest.mark.parametrize("sizes", [[5] * 8, [1, 2, 3, 4], [7, 1], [2, 2], [3] * 12, [1] * 6])
def test_things_in_places_of_their_own_are_parts(sizes: list[int]) -> None:
    for seed in range(5):
        changes, parts = blocks(sizes, seed=seed)
        assert found(changes) == parts


def test_things_that_touch_are_still_parts() -> None:
    """Each thing also changes, by a fifth as much, the places of another."""
    right = 0
    for seed in range(20):
        changes, parts = blocks([5] * 6, seed=seed)
        touching = changes + 0.2 * np.roll(changes, 20, axis=1)
        right += sum(part in parts for part in found(touching))
    assert right >= 0.8 * 6 * 20


def test_parts_divide_the_parameters() -> None:
    rng = np.random.default_rng(0)
    for n in (1, 2, 3, 17):
        parts = find_parts(overlaps(rng.random((n, 9))))
        assert sorted(np.concatenate(parts).tolist()) == list(range(n))
        assert all(len(part) for part in parts)


def test_parameters_without_effect_are_alone() -> None:
    changes, parts = blocks([4, 4])
    silent = np.concatenate([changes, np.zeros((2, changes.shape[1]))])
    assert found(silent) == sorted([*parts, [8], [9]])
