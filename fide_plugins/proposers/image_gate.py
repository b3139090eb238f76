"""Whether the image may steer the search, how far, and how many candidates are proposed."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from torch import Tensor

from fide_plugins.options import Options
from fide_plugins.runtime.schema import Schema, Stateful, real, whole
from fide_plugins.types import Float64, Mask

_MEMORY = 400  # candidates after which a generation counts for 1/e
_SURE = 3.0  # standard deviations
_SHORT_MEMORY = 100  # candidates, of how much the last generations agree
_ENOUGH = 20  # generations, before images may end a search
_SMALLEST, _LARGEST = 0.05, 0.8  # proposed fraction; from 0 it could not recover
_LITTLE, _MUCH = 0.2, 0.4  # mean rho; measured


class ImageGate(Stateful):
    """How far images steer the search, judged by what was evaluated.

    Spearman's rank correlation rho of losses with distances in features is computed for each
    generation.  If images said nothing, it would have mean 0 and variance 1 / (n - 1) (Kendall
    1948), and the sum of n rho over the generations, older ones counting less, would be about
    normal: images that agree lift it beyond 3 standard deviations in the first two generations.
    Misleading images can agree a little, too, so the mean of rho over the last generations says how
    far images are followed.

    options: `guard_images`, and `proposal_fraction` with its limits.
    channel_subsets: leading channels of the tokens in which distances are measured, the mean
        correlation counts; None: all channels.
    known: whether a learned model knows the picture, so that it is one of this scene.
    guarded: whether images are judged; where they are not, they are followed wholly.
    fraction: of a generation that is proposed, where images are followed wholly.
    """

    SCHEMA: ClassVar[dict[str, Schema]] = {
        "fraction": real(0.0, 1.0),
        "sum": real(-1e60, 1e60),
        "variance": real(0.0, 1e60),
        "recent": real(-1e60, 1e60),
        "weight": real(0.0, 1e60),
        "noted": whole(),
    }

    def __init__(
        self, options: Options, channel_subsets: tuple[int | None, ...], *, known: bool = False
    ) -> None:
        self.guarded = options.guard_images
        self._rate = options.fraction_rate
        self._channel_subsets = channel_subsets
        self.fraction = options.proposal_fraction
        self._sum = 0.0
        self._variance = 0.0  # of the sum, if images said nothing
        self._recent, self._weight = 0.0, 0.0  # sums of c n rho and c n, over a short memory
        self._noted = 0  # generations
        if known:
            self.note_known()

    @property
    def strength(self) -> float:
        """How far images are followed, in [0, 1]; where they are not, the search is CMA-ES.

        0 unless it is as good as certain that nearer images have lower losses, 1 where of late they
        agree much, in proportion between.
        """
        if not self.guarded:
            return 1.0
        if not 0 < _SURE * math.sqrt(self._variance) <= self._sum:
            return 0.0
        rho = self._recent / self._weight
        return min(1.0, max(0.0, (rho - _LITTLE) / (_MUCH - _LITTLE)))

    @property
    def agreement(self) -> float:
        """Rank correlation of losses and distances in features, of late; 0 before any is known."""
        return self._recent / self._weight if self._weight else 0.0

    @property
    def guided(self) -> bool:
        """Whether images say when a search is over, and where to go on.

        Misleading images may agree with losses for a while, so this takes some generations.
        """
        return self.strength == 1.0 and (not self.guarded or self._noted >= _ENOUGH)

    def number(self, popsize: int, rng: np.random.Generator) -> int:
        """How many of a generation to propose, at random around the expected number."""
        share = self.fraction * self.strength
        return min(int(share * popsize + rng.random()), popsize - 1) if share else 0

    def note_known(self) -> None:
        """Note that a learned model knows the picture."""
        self._noted = max(self._noted, _ENOUGH)

    def note_images(self, tokens: Tensor, target: Tensor, losses: Float64) -> None:
        """Note one generation: tokens (n, T, C) of images, those of the target, losses (n,).

        Losses are finite.  If all are equal, they say nothing.
        """
        n = len(losses)
        if not self.guarded or n < 2 or losses.min() == losses.max():
            return
        self._noted += 1
        squared = (tokens - target.to(tokens.device)).square()
        distances = [squared[..., :channels].sum(dim=(1, 2)) for channels in self._channel_subsets]
        ranks, rho = _ranks(losses), 0.0
        for own in (_ranks(d.cpu().numpy()) for d in distances):
            norm = float(np.sqrt((own @ own) * (ranks @ ranks)))
            rho += float(own @ ranks) / norm if norm > 0 else 0.0
        rho /= len(distances)
        keep = float(np.exp(-n / _MEMORY))
        self._sum = keep * self._sum + n * rho
        self._variance = keep**2 * self._variance + n**2 / (n - 1)
        keep = float(np.exp(-n / _SHORT_MEMORY))
        self._recent = keep * self._recent + n * rho
        self._weight = keep * self._weight + n

    def note_ranks(self, losses: Float64, proposed: Mask) -> None:
        """Raise `fraction` where proposals rank before samples, lower it where they rank behind.

        losses: (k,) of one generation; proposed: (k,), which of them a proposer made.
        The change is the rate times the difference of the mean ranks, in units of k / 2; a
        generation of one kind only says nothing.  Losses that are not finite are tied for the last
        ranks.
        """
        if not self._rate or proposed.all() or not proposed.any():
            return
        order = np.argsort(losses, kind="stable")
        ranks = np.empty(len(losses))
        ranks[order] = np.arange(len(losses))
        failed = ~np.isfinite(losses)
        if failed.any():
            ranks[failed] = ranks[failed].mean()  # all behind the others, and none before another
        lead = (ranks[~proposed].mean() - ranks[proposed].mean()) / (len(losses) / 2)
        self.fraction = float(np.clip(self.fraction + self._rate * lead, _SMALLEST, _LARGEST))


def _ranks(values: Float64) -> Float64:
    """Ranks (n,) around 0; equal values share their mean."""
    ordered = np.sort(values)
    before, with_equal = np.searchsorted(ordered, values), np.searchsorted(ordered, values, "right")
    ranks: Float64 = (before + with_equal - len(values)) / 2
    return ranks
