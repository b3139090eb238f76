"""Which samples tell about a solution, and which of them the linear model is made of.

A sample counts if its exchangeable blocks can be matched to those of the solution (`aligned`).
Those with the solution's own integers and choices are its *own*.  The model is made of the own ones
whose images are most like the solution's, without those of a twin, which has the same image far
away (`basin`).

Samples are known by their *rows* among the n of `Surroundings`, which are in the order of asking.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fide_plugins.population.candidate import TrainingSample, in_order
from fide_plugins.search.scene.axes import Axes
from fide_plugins.types import Float64, Indices, Mask
from fide_plugins.uncertainty.basin import of_twins
from fide_plugins.uncertainty.features import compressed, features_of, floored

__all__ = ["Surroundings", "aligned", "less_alike", "most_alike", "surroundings"]


_NEAREST, _EACH = 320, 6  # samples, or so many a parameter: noise widens what fewer say
_SPARE = 2  # times as many, of which those of twins are left out
_FEWEST = 2.0  # samples a parameter, and a few more
_MORE = 10
_ROUNDING = 1e-6  # of a coordinate that came back in single precision
_DIGITS = 1e-10  # of the energy of the image: 100 times its last digits, in single precision
_APART = 0.05  # of the cube: farther away than that no image is the solution's


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The samples of a run, as seen from a solution.

    points: (n, d), with blocks in the order of those of the solution.
    matched: (n,), samples of which the blocks could be matched.
    other: (n, d), coordinates of integers and choices that have another value.
    own: (m,), rows of the matched samples in which none has.
    u: (n, d), steps from the solution, the shorter way around.
    free: (d,), axes of numbers; p of them.
    periodic: (p,), which of these wrap around; None: none does.
    features: (n, f), of their images.
    distances: (n,), squared, from the features of the own sample at the solution.
    at: row of that sample.
    """

    points: Float64
    matched: Mask
    other: Mask
    own: Indices
    u: Float64
    free: Mask
    periodic: Mask | None
    features: Float64
    distances: Float64
    at: int

    def steps(self, rows: Indices) -> Float64:
        """Steps (m, p) to the samples in these rows (m,), on the axes of numbers."""
        return self.u[rows][:, self.free]


def surroundings(
    x: Float64,
    samples: Sequence[TrainingSample],
    channels: int | None,
    axes: Axes,
    discrete: Mask | None,
    blocks: Indices | None,
) -> Surroundings | None:
    """Of a solution x (d,); None if too few samples are its own, or none of them lies there.

    The arguments are those of `LocalEstimate`.
    """
    free = np.ones(len(x), bool) if discrete is None else ~discrete
    if not free.any() or len(samples) < _least(free):
        return None
    samples = in_order({(one.index, one.x.tobytes()): one for one in samples}.values())
    points, matched = aligned(np.array([sample.x for sample in samples]), x, blocks, axes)
    other = (np.abs(points - x) >= _ROUNDING) & ~free
    own = matched & ~other.any(axis=1)
    u = _signed(points - x, axes)
    away = np.where(own, np.abs(u).max(axis=1), np.inf)
    at = int(np.argmin(away))
    if own.sum() < _least(free) or away[at] > _APART:
        return None
    features = features_of([sample.tokens for sample in samples], channels)
    return Surroundings(
        points=points,
        matched=matched,
        other=other,
        own=np.flatnonzero(own),
        u=u,
        free=free,
        periodic=None if axes.periodic is None else axes.periodic[free],
        features=features,
        distances=np.square(features - features[at]).sum(axis=1),
        at=at,
    )


def most_alike(around: Surroundings, missed: float) -> Indices:
    """Rows of the samples of which the linear model is made, in the order of asking.

    missed: squared, by how much the solution misses the target.
    """
    number = max(_NEAREST, _EACH * int(around.free.sum()))
    pool = _nearest_images(_told_apart(around, missed), around.distances, _SPARE * number)
    e, _ = compressed(around.features[pool], around.features[around.at])
    twins = of_twins(around.steps(pool), e, floored(around.distances[pool]), around.periodic)
    rest = pool[~twins]
    enough = len(rest) >= _least(around.free)
    return _nearest_images(rest if enough else pool, around.distances, number)


def _told_apart(around: Surroundings, missed: float) -> Indices:
    """Rows of own samples, without those of which only the last digits differ, if enough are left.

    A search may converge farther than single precision tells.  Where a target with noise is missed
    by more, steps as short say nothing of how far away the truth is.
    """
    least = _DIGITS * float(np.square(around.features[around.at]).sum())
    told = around.own[(around.distances[around.own] >= least) | (around.own == around.at)]
    return told if missed > least and len(told) >= _least(around.free) else around.own


def less_alike(around: Surroundings, near: Indices) -> Indices:
    """Rows of `near` (m,), and of about as many others, spread evenly over the run."""
    rest = np.setdiff1d(around.own, near)
    return np.union1d(near, rest[:: max(1, len(rest) // len(near))])


def _least(free: Mask) -> int:
    """How many samples an estimate needs at least."""
    return int(_FEWEST * free.sum()) + _MORE


def _nearest_images(rows: Indices, distances: Float64, number: int) -> Indices:
    """So many of the rows with the least distances (n,), in the order of asking."""
    return np.sort(rows[np.argsort(distances[rows], kind="stable")[:number]])


def _signed(u: Float64, axes: Axes) -> Float64:
    """Steps u (n, d), the shorter way around where an axis is periodic."""
    if axes.periodic is None:
        return u
    return np.where(axes.periodic, (u + 0.5) % 1.0 - 0.5, u)


_NUMBERS = 2**22  # differences of blocks that are held at once


def aligned(
    points: Float64, x: Float64, blocks: Indices | None, axes: Axes
) -> tuple[Float64, Mask]:
    """Points (n, d) with their blocks in the order of those of x (d,); which could be matched.

    Each block of a point belongs to the nearest one of x; it can be matched if they all differ.
    """
    if blocks is None:
        return points, np.ones(len(points), bool)
    step = max(1, _NUMBERS // (blocks.size * len(blocks)))
    chunks = [points[i : i + step] for i in range(0, len(points), step)]
    parts = [_aligned(chunk, x, blocks, axes) for chunk in chunks]
    return np.concatenate([p for p, _ in parts]), np.concatenate([kept for _, kept in parts])


def _aligned(points: Float64, x: Float64, blocks: Indices, axes: Axes) -> tuple[Float64, Mask]:
    """As `aligned`, of as many points as memory holds."""
    own = points[:, blocks]  # (n, blocks, L)
    costs = axes.difference(own[:, :, None], x[blocks], blocks).max(axis=3)  # (n, own, of x)
    places = costs.argmin(axis=2)  # (n, own)
    which: Mask = (np.sort(places, axis=1) == np.arange(len(blocks))).all(axis=1)
    sources = np.argsort(places, axis=1)[..., None]  # the block that belongs to each of x
    ordered = points.copy()
    ordered[:, blocks] = np.take_along_axis(own, sources, axis=1)
    return np.where(which[:, None], ordered, points), which
