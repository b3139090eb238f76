"""The standard deviations of one solution, by the samples that were known when it was read.

The samples come from the run's memory (`search.memory`), in which every part of the run is found,
and the ends of searches.  Four steps:

1. *Select.*  Samples near the solution, with its own integers and choices (`selection`).
2. *Fit.*  A linear model of their features (`local_fit`).
3. *Covariance.*  What the model and the target say of the numbers (`covariance`).  Where they say
   nothing, samples with an image as good say how far away the truth may be (`as_good`).
4. *Other values.*  Integers and choices have no standard deviation.  Samples in which just one of
   them has another value say whether the picture tells the two apart (`values`).  So does one
   sample with another value, and any other parameters, whose image is as good.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from torch import Tensor

from fide_plugins.population.candidate import TrainingSample
from fide_plugins.runtime.threads import one_thread
from fide_plugins.search.scene.axes import Axes
from fide_plugins.types import Estimated, Float64, Indices, Mask
from fide_plugins.uncertainty.as_good import explain_as_well, limits, misses_of
from fide_plugins.uncertainty.covariance import deviations
from fide_plugins.uncertainty.features import compressed, features_of, floored, independent
from fide_plugins.uncertainty.local_fit import FitToTarget, fit_from_afar, fit_locally
from fide_plugins.uncertainty.selection import (
    Surroundings,
    less_alike,
    most_alike,
    surroundings,
)
from fide_plugins.uncertainty.values import OtherValue, Pairs, looks_alike, other_values

__all__ = ["LocalEstimate"]

_PARTS = (0.5, 0.65, 0.8)  # of the way, in logarithms, to the farthest features of the run


@dataclass(eq=False)
class LocalEstimate:
    """How sure the parameters of a solution are, computed when it is first read.

    x: (d,), the solution.
    samples: evaluated candidates; some may be in it twice.  Empty once `std` was read: a history of
        solutions would keep them all.
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
        missed = misses_of(around, target)
        near = most_alike(around, float(missed[around.at]))  # 1
        others = other_values(around, self.axes)
        model, pairs = self._fit(around, target, near, others)  # 2
        as_far = limits(around, missed, model, deviations(model))  # 3
        std[around.free] = deviations(model._replace(as_far=as_far))
        for other, pair in zip(others, pairs, strict=True):  # 4
            ambiguous[other.axes] |= looks_alike(model, pair)
        ambiguous |= self._differs(around, explain_as_well(around, missed, model))
        return Estimated(std, ambiguous)

    def _differs(self, around: Surroundings, good: Mask) -> Mask:
        """(d,), integers and choices that have another value in a sample that is good (n,)."""
        other = np.flatnonzero(around.other[around.matched & good].any(axis=0))
        return np.isin(np.arange(len(self.x)), self.axes.together(other))

    def _fit(
        self, around: Surroundings, target: Float64, near: Indices, others: Sequence[OtherValue]
    ) -> tuple[FitToTarget, list[Pairs]]:
        """The linear model of the samples `near` (m,), and the pairs of each other value.

        target: (f,), features of the target.

        The features of all of them, and of the target, are turned into few at once.
        """
        wide = less_alike(around, near)
        parts = [near, wide, *(rows for other in others for rows in (other.rows, other.own))]
        f = independent(target, len(self.target), around.features)
        every, target = compressed(around.features[np.concatenate(parts)], target)
        ends = np.cumsum([len(rows) for rows in parts])
        e, of_wide, *of_others = np.split(every, ends[:-1])
        fit = fit_locally(around.steps(near), e, floored(around.distances[near]))
        pairs = [
            Pairs(around.steps(other.rows), theirs, around.steps(other.own), own, other.own)
            for other, theirs, own in zip(others, of_others[::2], of_others[1::2], strict=True)
        ]
        farthest = float(around.distances[around.own].max())
        distances = floored(around.distances[wide])
        ratio = max(farthest / fit.reach, 1.0)
        from_afar = tuple(
            fit_from_afar(around.steps(wide), of_wide, distances, fit.reach * ratio**part)
            for part in _PARTS
        )
        return FitToTarget(fit, target, f, farthest, from_afar), pairs
