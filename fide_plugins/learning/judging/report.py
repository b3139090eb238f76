"""How good a model is, measured on held-out renders."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from fide_plugins.learning.judging.calibration import DRAWS, ENOUGH, OnPicture, in_region
from fide_plugins.learning.judging.seen import are_shown, of_any_block, scores
from fide_plugins.learning.networks.network import Network, as_input
from fide_plugins.learning.renders.renderer import Pixels
from fide_plugins.learning.training.one_training import HELD_OUT
from fide_plugins.search.mixed import distance
from fide_plugins.types import Float64, Mask

__all__ = ["Distance", "Report", "against_prior", "judge"]

_HYPOTHESES = 64
_PICTURES = 300
_BATCH = 500
_CALIBRATED = ENOUGH * HELD_OUT  # renders: every 50th is held out
_EXPLAINED = 0.9  # of the variance of renders: a worse emulator misleads


@dataclass(frozen=True)
class Report:
    """What held-out renders say of a model.

    renders: learned from.  failed: renders that failed.  held_out: renders not learned from.
    scale: by which all standard deviations of the density were multiplied, see `calibration`.
    fitted: how many held-out renders chose it; the other ones judge.
    seconds: of training the density, in all calls together.
    nll: mean negative log-likelihood in nats; the uniform prior has 0, so -nll is what was learned.
    within: share of pictures with one of 64 hypotheses within 0.05, and within 0.1, of the unit
        cube in every parameter that the images show; in all where they show none.
    coverage: share of pictures whose parameters are in the 90 % region of highest density.
    ranks: (d,), share of pictures whose parameter is between the 5 % and the 95 % quantile of its
        samples; simulation-based calibration (Talts et al. 2018, arXiv:1804.06788) has 0.9.  Not
        for exchangeable blocks, whose order means nothing: NaN.
    unseen: parameters of which the images tell nothing, as far as was learned, see `seen`;
        "lamps.x" is that of every block where blocks are exchangeable.
    curve: of each pass, see `training.one_training.Curve`.
    augment: how much its renders were changed, see `training.augmentation`.
    parameters: how many there are, as `unseen` names them; axes are more where a choice has
        several, or blocks are exchangeable.
    emulated: share of the variance of held-out renders that the emulator explains; None without
        an emulator.
    """

    renders: int
    failed: int
    held_out: int
    seconds: float
    nll: float
    within: tuple[float, float]
    coverage: float
    ranks: tuple[float, ...]
    unseen: tuple[str, ...]
    curve: tuple[tuple[float, float, float], ...]
    augment: str
    scale: float
    fitted: int
    parameters: int
    emulated: float | None

    def __str__(self) -> str:
        lines = [
            f"{self.renders:,} renders, {len(self.curve)} passes in {self.seconds:,.0f} s, "
            f"augment={self.augment!r}",
            *self._failed,
            f"{against_prior(self.nll)} on {self._judges:,} held-out renders{self._chosen}",
            *self._passes,
            *self._found,
            f"90 % regions hold the truth in {self._share(self.coverage)} of "
            f"{self._pictures} pictures",
            *self._single,
            self._calibrated,
        ]
        if self.emulated is not None:
            used = "it refines hypotheses" if self.emulates else "too little to be used"
            lines.append(
                f"the emulator explains {self._explained:.1%} of the variance of held-out renders: "
                f"{used}"
            )
        return "\n".join(lines)

    @property
    def emulates(self) -> bool:
        """Whether there is an emulator that is used: it explains nine tenths, as it is printed."""
        return self._explained >= _EXPLAINED

    @property
    def _explained(self) -> float:
        """Share of variance in whole tenths of a percent; 0 without an emulator."""
        return round(max(0.0, self.emulated or 0.0), 3)

    @property
    def _judges(self) -> int:
        """Held-out renders that did not choose the scale."""
        return self.held_out - self.fitted

    @property
    def _pictures(self) -> int:
        """The first of them, of which shares are."""
        return min(self._judges, _PICTURES)

    def _share(self, share: float) -> str:
        """Share of pictures with its standard error, as if there were one more of either kind."""
        n = self._pictures
        near = (share * n + 1) / (n + 2)
        return f"{share:.0%} +- {math.sqrt(near * (1 - near) / max(n, 1)):.0%}"

    @property
    def _failed(self) -> list[str]:
        """Line on renders that failed."""
        if not self.failed:
            return []
        what = "render failed and was" if self.failed == 1 else "renders failed and were"
        return [f"{self.failed:,} {what} left out: the model knows nothing there"]

    @property
    def _chosen(self) -> str:
        """What else the judges were used for: others are a little worse."""
        return "" if len(self.curve) < 2 else ", which also chose the pass"

    @property
    def _calibrated(self) -> str:
        """Line on the scale."""
        if not self.fitted:
            return f"not calibrated: that takes {_CALIBRATED:,} renders"
        return (
            f"calibrated by {self.fitted:,} other held-out renders: standard deviations times "
            f"{self.scale:.2f}"
        )

    @property
    def _passes(self) -> list[str]:
        """Line of the training curve: held-out nats after each pass; it says whether more help."""
        if len(self.curve) < 2:
            return []
        nats = ", ".join(f"{-held_out:.2f}" for _, _, held_out in self.curve)
        return [f"nats after each pass: {nats}"]

    @property
    def _single(self) -> list[str]:
        """Line on the calibration of single parameters, but for exchangeable blocks."""
        known = [share for share in self.ranks if math.isfinite(share)]
        if not known:
            return []
        low, high = f"{min(known):.0%}", f"{max(known):.0%}"
        return [
            "the truth is between the 5 % and the 95 % quantile of a parameter's samples in "
            f"{low if low == high else f'{low} to {high}'} of pictures (90 % is right, "
            f"+- {math.sqrt(0.9 * 0.1 / max(self._pictures, 1)):.0%} by chance)"
        ]

    @property
    def _found(self) -> list[str]:
        """Lines on how near hypotheses are; they say nothing of what was not learned."""
        near = (
            f"one of {_HYPOTHESES} hypotheses is within 0.05 of the box in "
            f"{self._share(self.within[0])}, within 0.1 in {self._share(self.within[1])} of "
            f"{self._pictures} pictures"
        )
        if not self.unseen:
            return [near]
        of = self.parameters
        them = "it" if len(self.unseen) == 1 else "them"
        why = f"the images do not show {them}, or it takes more renders or passes"
        if len(self.unseen) >= of:
            return [f"nothing was learned of any of the {of} parameters: {why}"]
        return [
            f"{near}, in the {of - len(self.unseen)} of {of} parameters that the images show",
            f"nothing was learned of {', '.join(self.unseen)}: {why}",
        ]

    def state_dict(self) -> dict[str, Any]:
        """All of it, as lists and numbers."""
        return asdict(self)

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Self:
        """Report of a state that `state_dict` gave."""
        lists = {"within", "ranks", "unseen"}
        plain: dict[str, Any] = {k: tuple(v) if k in lists else v for k, v in state.items()}
        plain["curve"] = tuple(tuple(row) for row in state["curve"])
        return cls(**plain)


def against_prior(nll: float) -> str:
    """In words, how a mean negative log-likelihood (nats) compares with that of the prior, 0."""
    return f"{abs(nll):.2f} nats {'worse' if nll > 0 else 'better'} than the uniform prior"


class Distance:
    """Largest difference of two points of the cube in any parameter, exchangeable blocks matched.

    periodic: (d,), axes that wrap around.  blocks: (n, L), axes of each exchangeable block.
    """

    def __init__(self, periodic: Mask, blocks: Sequence[Sequence[int]] = ()) -> None:
        self.periodic, self.blocks = periodic, np.array(blocks, np.intp)

    def __call__(self, X: Float64, x: Float64) -> Float64:
        """Distances (n,) of points X (n, d) from x (d,)."""
        if len(self.blocks) == 0:
            return np.asarray(distance(X, x, self.periodic).max(axis=1), np.float64)
        return np.array([distance(self.matched(row, x), x, self.periodic).max() for row in X])

    def matched(self, row: Float64, x: Float64) -> Float64:
        """Return the point `row` (d,) with its blocks in the order in which they are nearest x.

        That is the order with the least sum of differences of all parameters: each of them says
        something of which block is which.  `Exchangeability.aligned` sums the blocks' largest
        differences instead, since searches tell optima apart by the largest.  No search uses this
        one; it measures models.
        """
        wraps = self.periodic[self.blocks[0]]
        apart = distance(row[self.blocks][:, None], x[self.blocks][None], wraps)  # (n, n, L)
        apart = apart.sum(axis=-1)
        _, place = linear_sum_assignment(apart)
        sorted_ = row.copy()
        sorted_[self.blocks[place]] = row[self.blocks]
        return sorted_


@dataclass(frozen=True)
class Judgment:
    """What `judge` measures, see `Report`."""

    nll: float
    within: tuple[float, float]
    coverage: float
    ranks: tuple[float, ...]
    unseen: tuple[str, ...]
    parameters: int


@torch.no_grad()
def judge(
    network: Network,
    x: Float64,
    images: Pixels,
    names: Sequence[str],
    distance: Distance,
    seed: int = 0,
    on_picture: OnPicture | None = None,
) -> Judgment:
    """Judge a network on renders that it did not learn from, x (n, d) and images (n, H, W, 3).

    names: (d,), of the axes.
    """
    u = torch.from_numpy(x.astype(np.float32))
    each = [network.log_prob(as_input(some), at) for some, at in _batches(images, u)]
    nll = -float(torch.cat(each).mean())
    drawings, inside, ranks, told = [], [], [], []
    generator = torch.Generator().manual_seed(seed)
    pictures = min(len(x), _PICTURES)
    for i in range(pictures):
        image = as_input(images[i : i + 1])
        drawn = network.sample(image, DRAWS, generator)
        samples = drawn.numpy().astype(np.float64)
        drawings.append(samples[:_HYPOTHESES])
        inside.append(in_region(network, image, drawn, u[i]))
        ranks.append((samples < x[i]).mean(axis=0))
        told.append(scores(samples, x[i], distance.periodic, distance.blocks))
        if on_picture is not None:
            on_picture(i + 1, pictures)
    names = of_any_block(names, distance.blocks)
    shown = are_shown(np.array(told), names)
    near = [
        _nearest(samples, truth, shown if shown.any() else ~shown, distance)
        for samples, truth in zip(drawings, x, strict=False)
    ]
    return Judgment(
        nll=nll,
        within=(float(np.mean(np.array(near) <= 0.05)), float(np.mean(np.array(near) <= 0.1))),
        coverage=float(np.mean(inside)),
        ranks=tuple(_calibration(np.array(ranks), distance)),
        unseen=tuple(dict.fromkeys(n for n, s in zip(names, shown, strict=True) if not s)),
        parameters=len(set(names)),
    )


def _batches(images: Pixels, u: torch.Tensor) -> Iterator[tuple[Pixels, torch.Tensor]]:
    for first in range(0, len(u), _BATCH):
        yield images[first : first + _BATCH], u[first : first + _BATCH]


def _nearest(samples: Float64, truth: Float64, shown: Mask, distance: Distance) -> float:
    """Distance of the truth (d,) from the nearest of the samples (n, d), in what images show.

    The other axes are the same everywhere, so that they say nothing of which block is which.
    """
    return float(distance(np.where(shown, samples, 0.5), np.where(shown, truth, 0.5)).min())


def _calibration(ranks: Float64, distance: Distance) -> list[float]:
    """Share (d,) of ranks (n, d) within the middle nine tenths; NaN in exchangeable blocks."""
    share = ((ranks >= 0.05) & (ranks <= 0.95)).mean(axis=0)
    share[distance.blocks.ravel()] = np.nan
    return [float(each) for each in share]
