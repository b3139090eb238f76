"""How good a trained network is: calibrated and measured on held-out renders."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from scipy.stats import t
from torch import Tensor

from fide_plugins.learning.networks import Network, as_input
from fide_plugins.learning.renders import Pixels
from fide_plugins.learning.training import HELD_OUT, Training, is_held_out
from fide_plugins.search.mixed import distance
from fide_plugins.types import Float64, Indices, Mask

LARGEST_SCALE = 4.0
COVERAGE = 0.9  # of the region of highest density
DRAWS = 99  # so that a calibrated truth is among the 90 densest of 100 in 90 %
_SCALES = 16
_FEWEST, _MOST = 50, 300  # renders: they tell their share to 4 %, and to 2 %
ENOUGH = 2 * _FEWEST  # held-out renders for a scale, which half of them choose

_QUANTILE = 0.995  # of distances of renders: these are familiar
_MARGIN = 1.25  # a picture is not a render
_RIDGE = 1e-3  # of the mean variance
_FOLDS = 5
_FEW = 20  # held-out renders: with so many, a standard deviation is known to a sixth (1 / sqrt(2n))
_MOST_FEATURES = 4000  # renders by which the features of all are described

_BINS = 4
_LEAST = 0.02  # nats: less is of no use, however surely it is there
_ERRORS = 1.645  # standard errors of a mean: chance makes as much in 5 %
_NUMBER = re.compile(r"\[\d+\](?=\.)")  # of a repeated group

_HYPOTHESES = 64
_PICTURES = 300
_BATCH = 500
_EXPLAINED = 0.9  # of the variance of renders: a worse emulator misleads


# -- calibration -----------------------------------------------------------------------------------


def split_held_out(aside: Mask) -> tuple[Mask, Mask]:
    """Split held-out renders (n,) bool into those that choose the scale and those that judge.

    Every second one chooses, at most 300; none, and so no scale, where these were fewer than 50.
    """
    fit, held_out = np.zeros_like(aside), np.flatnonzero(aside)
    if len(held_out) >= ENOUGH:
        fit[held_out[::2][:_MOST]] = True
    return fit, aside & ~fit


def fitted_scale(network: Network, x: Float64, images: Pixels, seed: int = 0) -> float:
    """Scale in [1, 4] by which 90 % regions hold 90 % of renders, x (n, d), images (n, H, W, 3).

    A network that has seen its renders several times is too sure of itself; one scale of all
    standard deviations mends it, as in temperature scaling (Guo et al. 2017, arXiv:1706.04599).
    1 without renders, or where regions hold 90 % already; they are never made smaller, since
    photographs are further from what was learned than renders are.  The network is left as it was.
    """
    before, u = network.scale, torch.from_numpy(x.astype(np.float32))
    try:
        for network.scale in np.geomspace(1.0, LARGEST_SCALE, _SCALES).tolist():
            generator, inside = torch.Generator().manual_seed(seed), 0
            for i in range(len(x)):
                image = as_input(images[i : i + 1])
                drawn = network.sample(image, DRAWS, generator)
                inside += in_region(network, image, drawn, u[i])
            if inside >= COVERAGE * len(x):
                break
        return network.scale
    finally:
        network.scale = before


@torch.no_grad()
def in_region(network: Network, image: Tensor, drawn: Tensor, u: Tensor) -> bool:
    """Whether u (d,) is in the region of highest density that holds 90 % of the drawn (n, d)."""
    density = network.log_prob(image, torch.cat([u[None], drawn]))
    less = int((density[1:] <= density[0]).sum())  # none of a density that is not a number
    return less > (1 - COVERAGE) * len(drawn)


# -- familiarity -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Familiarity:
    """Mean (F,) and precision (F, F) of features, and the distance that is still familiar."""

    mean: Float64
    precision: Float64
    threshold: float

    @classmethod
    def of(cls, training: Float64, held_out: Float64) -> Self:
        """Familiarity of features (n, F) of training renders, judged on others (m, F)."""
        mean, precision = _moments(training)
        distances = cls(mean, precision, 0.0).distances(held_out)
        others = _across(training) if len(held_out) < _FEW else np.empty(0)
        return cls(mean, precision, _MARGIN * _usual(distances, others))

    def distances(self, features: Float64) -> Float64:
        """Mahalanobis distances (n,) of features (n, F)."""
        centered = features - self.mean
        squares = np.einsum("nf,fg,ng->n", centered, self.precision, centered)
        return np.asarray(np.sqrt(np.maximum(squares, 0.0)), np.float64)


def _across(training: Float64) -> Float64:
    """Distance (n,) of each of n renders from those of the other folds."""
    fold = np.arange(len(training)) % _FOLDS
    found = np.empty(len(training))
    for k in range(_FOLDS):
        others = Familiarity(*_moments(training[fold != k]), 0.0)
        found[fold == k] = others.distances(training[fold == k])
    return found


def _moments(features: Float64) -> tuple[Float64, Float64]:
    """Mean (F,) and precision (F, F) of features (n, F)."""
    covariance = np.atleast_2d(np.cov(features, rowvar=False))
    ridge = _RIDGE * max(float(np.trace(covariance)) / features.shape[1], 1e-12)
    inverse = np.linalg.inv(covariance + ridge * np.eye(features.shape[1]))
    return features.mean(axis=0), np.asarray(inverse, np.float64)


def _usual(distances: Float64, others: Float64) -> float:
    """Distance that hardly any further render exceeds, by those of some (m,).

    others: (n,), distances that vary as these do, of another size perhaps.
    """
    seen = float(np.quantile(distances, _QUANTILE))
    samples = [_logs(some) for some in (distances, others) if len(some) > 1]
    freedom = sum(len(logs) - 1 for logs in samples)
    if freedom == 0 or seen == 0:
        return seen
    variance = sum(float(np.square(logs - logs.mean()).sum()) for logs in samples) / freedom
    error = np.sqrt(variance * (1 + 1 / len(distances)))
    return max(seen, float(np.exp(_logs(distances).mean() + t.ppf(_QUANTILE, freedom) * error)))


def _logs(distances: Float64) -> Float64:
    """Logarithms (m,), bounded for distances that are 0."""
    largest = max(float(distances.max()), 1e-300)
    return np.asarray(np.log(np.maximum(distances, 1e-3 * largest)), np.float64)


def familiarity_of(network: Network, training: Training) -> Familiarity:
    """Familiarity of the renders of a training, the held-out ones among them."""
    aside = is_held_out(len(training.x))

    def features(rows: Indices) -> Float64:
        images = training.shown(rows)
        parts = [images[i : i + _BATCH] for i in range(0, len(rows), _BATCH)]
        vectors = torch.cat([network.vectors(as_input(part)) for part in parts])
        return np.asarray(vectors.numpy(), np.float64)

    learned = np.flatnonzero(~aside)[:_MOST_FEATURES]
    return Familiarity.of(features(learned), features(np.flatnonzero(aside)))


# -- which parameters images show ------------------------------------------------------------------


def scores(samples: Float64, truth: Float64, blocks: Indices) -> Float64:
    """Log scores (d,) in nats of the samples (n, d) of one image, given its truth (d,).

    A model may be sure of what no image shows, so the truth of held-out renders decides: the
    logarithm of the samples' share in its quarter of an axis, less that of the uniform density, is
    0 on average where nothing was learned (Gneiting and Raftery 2007).  Blocks count together.
    """
    counts = np.stack([(_quarters(samples) == k).sum(axis=0) for k in range(_BINS)], axis=1)
    p = (counts + 0.5) / (len(samples) + 0.5 * _BINS)  # (d, bins), never 0
    for same in blocks.T:
        p[same] = p[same].mean(axis=0)
    gain: Float64 = np.log(p[np.arange(len(truth)), _quarters(truth)] * _BINS)
    for same in blocks.T:
        gain[same] = gain[same].mean()
    return gain


def are_shown(scored: Float64, names: Sequence[str]) -> Mask:
    """Which axes (d,) belong to parameters that images show, by scores (n, d) of n images.

    names: (d,), of the parameters.  One of several axes is enough, as of a choice.
    """
    mean, n = scored.mean(axis=0), len(scored)
    error = scored.std(axis=0, ddof=1) / np.sqrt(n) if n > 1 else np.zeros_like(mean)
    shown = (mean >= _LEAST) & (mean >= _ERRORS * error)
    known = {name for name, each in zip(names, shown, strict=True) if each}
    return np.array([name in known for name in names])


def _quarters(x: Float64) -> Indices:
    """Quarter 0 to 3 of each coordinate."""
    return np.minimum((x * _BINS).astype(np.intp), _BINS - 1)


# -- report ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Report:
    """What held-out renders say of a model.

    renders: learned from.  failed: renders that failed.  held_out: renders not learned from.
    scale: by which all standard deviations of the density were multiplied, see `fitted_scale`.
    fitted: how many held-out renders chose it; the other ones judge.
    seconds: of training the density, in all calls together.
    nll: mean negative log-likelihood in nats; the uniform prior has 0, so -nll is what was learned.
    within: share of pictures with one of 64 hypotheses within 0.05, and within 0.1, of the unit
        cube in every parameter that the images show; in all where they show none.
    coverage: share of pictures whose parameters are in the 90 % region of highest density.
    unseen: parameters of which the images tell nothing, as far as was learned, see `are_shown`;
        "lamps.x" is that of every block where blocks are exchangeable.
    curve: of each pass, see `training.Curve`.
    augment: how much its renders were changed, see `augmentation`.
    emulated: share of the variance of held-out renders that the emulator explains; None without
        an emulator.
    clutter: what renders were composed with, in words; None: nothing.
    """

    renders: int
    failed: int
    held_out: int
    seconds: float
    nll: float
    within: tuple[float, float]
    coverage: float
    unseen: tuple[str, ...]
    curve: tuple[tuple[float, float, float], ...]
    augment: str
    scale: float
    fitted: int
    emulated: float | None
    clutter: str | None = None

    def __str__(self) -> str:
        judges = self.held_out - self.fitted  # held-out renders that did not choose the scale
        pictures = min(judges, _PICTURES)
        near, nearly, inside = (_share(p, pictures) for p in (*self.within, self.coverage))
        calibrated = f"not calibrated: that takes {ENOUGH * HELD_OUT:,} renders"
        if self.fitted:
            calibrated = f"calibrated: standard deviations times {self.scale:.2f}"
        clutter = "" if self.clutter is None else f", {self.clutter}"
        lines = [
            f"{self.renders:,} renders, {len(self.curve)} passes in {self.seconds:,.0f} s, "
            f"augment={self.augment!r}{clutter}",
            f"{against_prior(self.nll)} on {judges:,} held-out renders",
            f"one of {_HYPOTHESES} hypotheses is within 0.05 of the box in {near}, within 0.1 in "
            f"{nearly} of {pictures} pictures, in the parameters that the images show",
            f"90 % regions hold the truth in {inside} of {pictures} pictures; {calibrated}",
        ]
        if self.unseen:
            why = "the images do not show it, or it takes more renders or passes"
            lines.append(f"nothing was learned of {', '.join(self.unseen)}: {why}")
        if self.failed:
            lines.append(f"renders that failed and were left out: {self.failed:,}")
        if self.emulated is not None:
            used = "it refines hypotheses" if self.emulates else "too little to be used"
            explained = max(0.0, self.emulated)
            lines.append(f"the emulator explains {explained:.1%} of the variance: {used}")
        return "\n".join(lines)

    @property
    def emulates(self) -> bool:
        """Whether there is an emulator that is used: it explains nine tenths, as it is printed."""
        return round(self.emulated or 0.0, 3) >= _EXPLAINED


def _share(share: float, n: int) -> str:
    """Share of n pictures with its standard error, as if there were one more of either kind."""
    near = (share * n + 1) / (n + 2)
    return f"{share:.0%} +- {math.sqrt(near * (1 - near) / max(n, 1)):.0%}"


def against_prior(nll: float) -> str:
    """In words, how a mean negative log-likelihood (nats) compares with that of the prior, 0."""
    return f"{abs(nll):.2f} nats {'worse' if nll > 0 else 'better'} than the uniform prior"


def matched(
    row: Float64, x: Float64, periodic: Sequence[bool], blocks: Sequence[Sequence[int]]
) -> Float64:
    """The point `row` (d,) with its blocks in the order with the least sum of differences to x."""
    if not len(blocks):
        return row
    index = np.array(blocks, np.intp)  # (n, L)
    wraps = np.array(periodic)[index[0]]
    apart = distance(row[index][:, None], x[index][None], wraps)  # (n, n, L)
    _, place = linear_sum_assignment(apart.sum(axis=-1))
    ordered = row.copy()
    ordered[index[place]] = row[index]
    return ordered


def report_of(
    network: Network, training: Training, names: Sequence[str], *,
    failed: int, emulated: float | None, on_picture: Callable[[int, int], None],
) -> Report:  # fmt: skip
    """Calibrate the network, which its training has left, and judge it on held-out renders.

    names: (d,), of the axes.  failed: renders that failed.  emulated: see `Report`.
    on_picture: called with how many pictures are judged, and of how many.
    """
    x, seed = training.x, training.seed
    aside = is_held_out(len(x))
    fit, judges = split_held_out(aside)
    images = training.shown(np.flatnonzero(fit))
    network.scale = fitted_scale(network, x[fit], images, seed)
    images = training.shown(np.flatnonzero(judges))
    return Report(
        renders=int((~aside).sum()), failed=failed, held_out=int(aside.sum()),
        seconds=training.spent, curve=tuple((a, b, c) for a, b, c in training.curve),
        augment=training.augment, scale=network.scale, fitted=int(fit.sum()), emulated=emulated,
        clutter=None if training.clutter is None else training.clutter.name,
        **_judged(network, x[judges], images, names, seed, on_picture),
    )  # fmt: skip


@torch.no_grad()
def _judged(
    network: Network, x: Float64, images: Pixels, names: Sequence[str], seed: int,
    on_picture: Callable[[int, int], None],
) -> dict[str, Any]:  # fmt: skip
    """Those fields of `Report` that renders measure, x (n, d) and images (n, H, W, 3)."""
    periodic, blocks = network.periodic, np.array(network.blocks, np.intp)
    u = torch.from_numpy(x.astype(np.float32))
    starts = range(0, len(u), _BATCH)
    each = [network.log_prob(as_input(images[i : i + _BATCH]), u[i : i + _BATCH]) for i in starts]
    drawings, inside, told = [], [], []
    generator = torch.Generator().manual_seed(seed)
    pictures = min(len(x), _PICTURES)
    for i in range(pictures):
        image = as_input(images[i : i + 1])
        drawn = network.sample(image, DRAWS, generator)
        samples = drawn.numpy().astype(np.float64)
        drawings.append(samples[:_HYPOTHESES])
        inside.append(in_region(network, image, drawn, u[i]))
        told.append(scores(samples, x[i], blocks))
        on_picture(i + 1, pictures)
    in_blocks = set(blocks.ravel().tolist())
    names = [_NUMBER.sub("", one) if i in in_blocks else one for i, one in enumerate(names)]
    shown = are_shown(np.array(told), names)
    counted = shown if shown.any() else ~shown
    near = []
    for samples, truth in zip(drawings, x, strict=False):
        some, at = np.where(counted, samples, 0.5), np.where(counted, truth, 0.5)
        ordered = np.array([matched(row, at, periodic, network.blocks) for row in some])
        near.append(distance(ordered, at, np.array(periodic)).max(axis=1).min())
    return {
        "nll": -float(torch.cat(each).mean()),
        "within": (float(np.less_equal(near, 0.05).mean()), float(np.less_equal(near, 0.1).mean())),
        "coverage": float(np.mean(inside)),
        "unseen": tuple(dict.fromkeys(n for n, s in zip(names, shown, strict=True) if not s)),
    }
