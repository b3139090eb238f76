"""The standard deviations of one solution, by the samples that were known when it was read.

The samples come from the run's memory (`search.memory`), in which every part of the run is found,
and the ends of searches.  Exchangeable blocks are matched to those of the solution; a sample whose
blocks cannot be matched one to one is left out.  So are samples in which an integer or a choice
has another value: they have no standard deviation themselves, and their samples say whether the
picture tells the values apart (`values`).  Samples of a twin, which has the same image far away,
are left out (`basin`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from torch import Tensor

from fide_plugins.population.training_sample import TrainingSample, in_order
from fide_plugins.runtime.threads import one_thread
from fide_plugins.search.scene.axes import Axes
from fide_plugins.types import Float64, Indices, Mask
from fide_plugins.uncertainty.basin import of_twins
from fide_plugins.uncertainty.covariance import covariance
from fide_plugins.uncertainty.local_fit import LocalFit, fit_locally
from fide_plugins.uncertainty.values import FEWEST, Pairs, looks_alike

__all__ = ["LocalEstimate"]

_NUMBERS = 2**22  # differences of blocks that are held at once
_NEAREST, _EACH = 320, 6  # samples, or so many a parameter: noise widens what fewer say
_SPARE = 2  # times as many, of which those of twins are left out
_FEWEST = 2.0  # samples a parameter, and a few more
_MORE = 10
_ROUNDING = 1e-6  # of a coordinate that came back in single precision
_APART = 0.05  # of the cube: farther away than that no image is the solution's


@dataclass(frozen=True, eq=False)
class LocalEstimate:
    """How sure the parameters of a solution are, computed when it is first read.

    x: (d,), the solution.
    samples: evaluated candidates; some may be in it twice.  Kept until `std` is read.
    target: (T, C), tokens.
    channels: so many leading channels of the tokens count; None: all.
    axes: which of them are periodic.
    discrete: (d,), axes of integers and choices; None: there are none.
    blocks: (n, L), exchangeable blocks; None: there are none.
    """

    x: Float64
    samples: Sequence[TrainingSample]
    target: Tensor
    channels: int | None
    axes: Axes
    discrete: Mask | None = None
    blocks: Indices | None = None

    @property
    def std(self) -> Float64 | None:
        """(d,), NaN for integers and choices; None where too few samples are known."""
        return self._both[0]

    @property
    def ambiguous(self) -> Mask:
        """(d,), integers and choices of which another value may be the true one."""
        return self._both[1]

    @cached_property
    def _both(self) -> tuple[Float64 | None, Mask]:
        both = self._computed()
        object.__setattr__(self, "samples", ())  # a history of solutions would keep them all
        return both

    @one_thread
    def _computed(self) -> tuple[Float64 | None, Mask]:
        nothing = np.zeros(len(self.x), bool)
        held = nothing if self.discrete is None else self.discrete
        free = ~held
        least = int(_FEWEST * free.sum()) + _MORE
        if not free.any() or len(self.samples) < least:
            return None, nothing
        samples = in_order({(one.index, one.x.tobytes()): one for one in self.samples}.values())
        points = np.array([sample.x for sample in samples])
        points, matched = aligned(points, self.x, self.blocks, self.axes)
        others = np.abs(points - self.x) >= _ROUNDING  # (n, d)
        kept = matched & ~others[:, held].any(axis=1)
        u = _signed(points - self.x, self.axes)
        nearest = int(np.argmin(np.where(kept, np.abs(u).max(axis=1), np.inf)))
        if kept.sum() < least or np.abs(u[nearest]).max() > _APART:
            return None, nothing
        seen = self._features([sample.tokens for sample in samples])
        distances = np.square(seen - seen[nearest]).sum(axis=1)  # (n,)
        number = max(_NEAREST, _EACH * int(free.sum()))
        own = np.flatnonzero(kept)
        pool = _most_alike(own, distances, _SPARE * number)
        e, _ = _compressed(seen[pool], seen[nearest])
        periodic = None if self.axes.periodic is None else self.axes.periodic[free]
        rest = pool[~of_twins(u[pool][:, free], e, _floored(distances[pool]), periodic)]
        near = _most_alike(rest if len(rest) >= least else pool, distances, number)
        values = self._other_values(points, matched, others & held)
        pairs = [(unit, rows, _nearest(own, rows)) for unit, rows in values]
        rows = np.concatenate([near, *(one for _, *both in pairs for one in both)])
        e, target = _compressed(seen[rows], self._features([self.target])[0])
        fit = fit_locally(u[near][:, free], e[: len(near)], _floored(distances[near]))
        std = np.full(len(self.x), np.nan)
        std[free] = np.sqrt(np.diag(covariance(fit, target, seen.shape[1])))
        known = fit, target, seen.shape[1]
        return std, self._ambiguous(pairs, known, u[:, free], e[len(near) :])

    def _ambiguous(
        self,
        pairs: Sequence[tuple[Indices, Indices, Indices]],
        known: tuple[LocalFit, Float64, int],
        u: Float64,
        e: Float64,
    ) -> Mask:
        """(d,), see `ambiguous`.

        pairs: axes of a parameter, samples with another value of it, and with that of the solution.
        known: see `looks_alike`.  u: (n, free), of all samples.  e: features of those of `pairs`.
        """
        ambiguous = np.zeros(len(self.x), bool)
        for unit, rows, own in pairs:
            n = len(rows)
            pair = Pairs(u[rows], e[:n], u[own], e[n : 2 * n], own)
            ambiguous[unit] |= looks_alike(*known, pair)
            e = e[2 * n :]
        return ambiguous

    def _other_values(
        self, points: Float64, matched: Mask, others: Mask
    ) -> list[tuple[Indices, Indices]]:
        """Axes of a parameter, and samples that have just another value of it, for each value."""
        found = []
        for unit in (unit for unit in self.axes.axes_of if others[:, unit].any()):
            rest = np.ones(len(self.x), bool)
            rest[unit] = False
            which = np.flatnonzero(
                matched & others[:, unit].any(axis=1) & ~others[:, rest].any(axis=1)
            )
            values = np.round(points[which][:, unit], 6)
            for value in np.unique(values, axis=0):
                rows = which[(values == value).all(axis=1)]
                if len(rows) >= FEWEST:
                    found.append((unit, rows))
        return found

    def _features(self, tokens: Sequence[Tensor]) -> Float64:
        """(n, f), of the channels that count."""
        rows = [one.detach()[..., : self.channels].cpu().numpy().ravel() for one in tokens]
        return np.array(rows, np.float64)


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


def _most_alike(own: Indices, distances: Float64, number: int) -> Indices:
    """So many of the samples `own` with the least distances (n,), in the order of asking."""
    return np.sort(own[np.argsort(distances[own], kind="stable")[:number]])


def _nearest(own: Indices, rows: Indices) -> Indices:
    """Of the samples `own`, in the order of asking, that nearest in time to each of `rows`."""
    after = np.clip(np.searchsorted(own, rows), 1, len(own) - 1)
    before = after - 1
    return np.where(rows - own[before] <= own[after] - rows, own[before], own[after])


def _signed(u: Float64, axes: Axes) -> Float64:
    """Steps u (n, d), the shorter way around where an axis is periodic."""
    if axes.periodic is None:
        return u
    return np.where(axes.periodic, (u + 0.5) % 1.0 - 0.5, u)


def _floored(distances: Float64) -> Float64:
    """Squared distances (n,); that of the solution from itself as small as the next one."""
    moved = distances[distances > 0]
    return np.maximum(distances, moved.min() if len(moved) else 1.0)


def _compressed(e: Float64, target: Float64) -> tuple[Float64, Float64]:
    """Features (n, f) and those of the target (f,), turned into the few directions they span."""
    if e.shape[1] <= 2 * (len(e) + 1):
        return e, target
    both = np.vstack([e, target])
    rows: Float64 = np.asarray(np.linalg.qr(both.T, mode="r")).T  # their products are the same
    return rows[:-1], rows[-1]
