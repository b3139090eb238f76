"""The standard deviations of one solution, by the samples that were known when it was read.

Samples are known by their *rows* among the n of `Surroundings`, which are in the order of asking.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.distance import cdist
from torch import Tensor

from fide_plugins.population import BY_INDEX, TrainingSample
from fide_plugins.runtime.threads import one_thread
from fide_plugins.search import mixed
from fide_plugins.search.mixed import Axes
from fide_plugins.types import OPEN, Estimated, Float64, Indices, Mask
from fide_plugins.uncertainty.local_fit import (
    NO_EFFECT,
    WIDER,
    FitToTarget,
    covariance,
    fit_locally,
    noise_of,
)

_ODDS = 4.0  # twice the logarithm of the likelihood ratio up to which both may be true
_LUCK = 4.0  # standard deviations of what noise of the renders changes; the best had luck
_ROUNDING = (1 / 255) ** 2 / 12  # mean squared error of 8 bits
_MOST = 600  # samples that are compared with each other
_SAME = 1e-9  # of the largest change of the image: neither is better
_DECIMALS = 6  # of a feature, in single precision


def features_of(tokens: Sequence[Tensor], channels: int | None) -> Float64:
    """(n, f), of n times tokens (T, C); so many leading channels count, None: all."""
    rows = [one.detach()[..., :channels].cpu().numpy().ravel() for one in tokens]
    return np.array(rows, np.float64)


def independent(target: Float64, tokens: int, features: Float64) -> int:
    """How many features of the target (f,), so many tokens, are independent, at least one.

    Channels that are equal in all tokens count once, but never less than a third of them: a gray
    picture has three equal colors, and its noise is the same in each.  Tokens that equal the
    target's in all samples do not count: a mask hides them.

    features: (n, f), of samples.
    """
    channels = np.round(target.reshape(tokens, -1).T, _DECIMALS)
    different = max(len(np.unique(channels, axis=0)), math.ceil(len(channels) / 3))
    apart = np.abs(features - target).max(axis=0)
    shown = (apart.reshape(tokens, -1) > 10**-_DECIMALS).any(axis=1)
    return max(1, int(shown.sum())) * different


_NEAREST, _EACH = 320, 6  # samples, or so many a parameter: noise widens what fewer say
_FEWEST = 2.0  # samples a parameter, and a few more
_FEW_MORE = 10
_COORDINATE = 1e-6  # of a coordinate that came back in single precision
_DIGITS = 1e-10  # of the energy of the image: 100 times its last digits, in single precision
_APART = 0.05  # of the cube: farther away than that no image is the solution's


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The samples of a run, as seen from a solution.

    points: (n, d), with blocks in the order of those of the solution; matched: (n,), where these
        could be matched.
    other: (n, d), coordinates of integers and choices that have another value; own: (m,), rows of
        the matched samples in which none has.
    u: (n, d), steps from the solution, the shorter way around.
    free: (d,), axes of numbers; p of them; periodic: (p,), which of these wrap around, or None.
    features: (n, f), of their images; distances: (n,), squared, of these from those of the own
        sample at the solution, which is in row `at`.
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
    """Of a solution x (d,), see `LocalEstimate`; None if too few samples are its own."""
    free = np.ones(len(x), bool) if discrete is None else ~discrete
    if not free.any() or len(samples) < _least(free):
        return None
    different = {(one.index, one.x.tobytes()): one for one in samples}
    samples = sorted(different.values(), key=BY_INDEX)
    points, matched = aligned(np.array([sample.x for sample in samples]), x, blocks, axes)
    other = (np.abs(points - x) >= _COORDINATE) & ~free
    own = matched & ~other.any(axis=1)
    u = mixed.shorter(points - x, axes.periodic)
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
    """Rows of the own samples whose images are most like the solution's, in the order of asking.

    A search may converge farther than single precision tells.  Samples of which only the last
    digits differ do not count where the target is missed (squared) by more, if others are left.
    """
    least = _DIGITS * float(np.square(around.features[around.at]).sum())
    rows = around.own[(around.distances[around.own] >= least) | (around.own == around.at)]
    if missed <= least or len(rows) < _least(around.free):
        rows = around.own
    number = max(_NEAREST, _EACH * int(around.free.sum()))
    return np.sort(rows[np.argsort(around.distances[rows], kind="stable")[:number]])


def _least(free: Mask) -> int:
    """How many samples an estimate needs at least."""
    return int(_FEWEST * free.sum()) + _FEW_MORE


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


def limits(around: Surroundings, missed: Float64, model: FitToTarget, std: Float64) -> Float64:
    """How far (p,) the truth may be in each number that is open; infinite where nothing limits it.

    What the model leaves open is open only where samples speak for it: an image as good lies far
    away in that number, or the number has no effect.  missed: (n,), squared.  std: (p,), alone.
    """
    more = max(NO_EFFECT * model.farthest, _as_good(model))
    good = around.own[missed[around.own] <= missed[around.at] + more]
    far = np.abs(around.steps(good)).max(axis=0)
    limited = np.full(len(std), np.inf)
    for one in np.flatnonzero((std >= OPEN) & (far < OPEN)):
        if not _without_effect(around, int(one)):
            limited[one] = WIDER * far[one]
    return limited


def _as_good(model: FitToTarget) -> float:
    """By how much more, squared, a sample may miss the target and be as good a solution."""
    noise = noise_of(model)
    # by how much the noise of a render changes what it misses: a standard deviation, squared errors
    luck = _LUCK * (2 * model.fit.s * (model.fit.s / model.f + 2 * noise)) ** 0.5
    return float(_ODDS * noise + luck)


def _without_effect(around: Surroundings, one: int) -> bool:
    """Whether neighbors in all other numbers are the better ones: the search leaves it as it is."""
    rows = around.own[:: -(-len(around.own) // _MOST)]
    u, e = around.steps(rows), around.features[rows]
    others = np.arange(u.shape[1]) != one
    apart = _apart(u, others, around.periodic)
    np.fill_diagonal(apart, np.inf)
    with_it, without = (
        np.square(e - e[gaps.argmin(axis=1)]).sum(axis=1)
        for gaps in (apart + _apart(u, ~others, around.periodic), apart)
    )
    same = _SAME * float(around.distances[around.own].max())
    worse, better = (without > with_it + same).sum(), (without < with_it - same).sum()
    return bool(worse <= better)


def _apart(u: Float64, which: Mask, periodic: Mask | None) -> Float64:
    """Squared distances (n, n) of samples u (n, p) in some numbers (p,), the shorter way around."""
    around = np.zeros(len(which), bool) if periodic is None else periodic
    apart: Float64 = cdist(u[:, which & ~around], u[:, which & ~around], "sqeuclidean")
    for angle in u.T[which & around]:
        gaps = np.abs(angle[:, None] - angle)
        apart += np.square(np.minimum(gaps, 1.0 - gaps))
    return apart


@dataclass(eq=False)
class LocalEstimate:
    """How sure the parameters of a solution are, computed when it is first read.

    samples: evaluated candidates, some perhaps twice; empty once `std` was read.
    target: (T, C), tokens, of which so many leading `channels` count; None: all.
    discrete: (d,), axes of integers and choices.  blocks: (n, L), exchangeable ones.
    """

    x: Float64
    samples: Sequence[TrainingSample]
    target: Tensor
    channels: int | None
    axes: Axes
    discrete: Mask | None = None
    blocks: Indices | None = None
    _found: Estimated | None = field(default=None, init=False, repr=False)

    @property
    def std(self) -> Float64 | None:
        """(d,), NaN for integers and choices; None where too few samples are known."""
        return self._estimated.std

    @property
    def rough(self) -> bool:
        """True: another path of the search has other samples."""
        return True

    @property
    def ambiguous(self) -> Mask | None:
        """(d,), integers and choices of which another value may be the true one."""
        return self._estimated.ambiguous

    @property
    def _estimated(self) -> Estimated:
        samples = self.samples  # before the question: another thread empties them after its answer
        if self._found is None:
            with np.errstate(under="ignore"):  # of a user who lets it raise; here it is 0
                self._found = self._compute(samples)
            self.samples = ()
        return self._found

    @one_thread
    def _compute(self, samples: Sequence[TrainingSample]) -> Estimated:
        std, ambiguous = np.full(len(self.x), np.nan), np.zeros(len(self.x), bool)
        around = surroundings(self.x, samples, self.channels, self.axes, self.discrete, self.blocks)
        if around is None:
            return Estimated(None, ambiguous)
        target = features_of([self.target], self.channels)[0]
        missed = np.square(around.features - target).sum(axis=1)
        near = most_alike(around, float(missed[around.at]))  # 1
        model = self._fit(around, target, near)  # 2
        alone = np.sqrt(np.diag(covariance(model)))
        model = model._replace(as_far=limits(around, missed, model, alone))  # 3
        std[around.free] = np.sqrt(np.diag(covariance(model)))
        # another value of which an image is as good to 8 bits, or within the noise of the target
        least = _ROUNDING * around.features.shape[1]
        good = missed <= max(missed[around.at] + _as_good(model), least)
        differs = np.flatnonzero(around.other[around.matched & good].any(axis=0))
        ambiguous |= np.isin(np.arange(len(self.x)), self.axes.together(differs))
        return Estimated(std, ambiguous)

    def _fit(self, around: Surroundings, target: Float64, near: Indices) -> FitToTarget:
        """The linear model of the samples `near` (m,)."""
        f = independent(target, len(self.target), around.features)
        e, distances = around.features[near], around.distances[near]
        if e.shape[1] > 2 * (len(e) + 1):  # the few directions that they span: equal products
            rows: Float64 = np.asarray(np.linalg.qr(np.vstack([e, target]).T, mode="r")).T
            e, target = rows[:-1], rows[-1]
        moved = distances[distances > 0]  # that of the solution from itself is as small as the next
        distances = np.maximum(distances, moved.min() if len(moved) else 1.0)
        fit = fit_locally(around.steps(near), e, distances)
        farthest = float(around.distances[around.own].max())
        return FitToTarget(fit, target, f, farthest)
