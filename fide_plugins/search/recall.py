"""Where the search for another picture begins, from what was rendered for earlier ones.

It begins at the candidate b whose image is nearest to the new picture, as wide as those remembered
candidates say whose images differ from that of b by what is wrong with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from torch import Tensor

from fide_plugins.population.candidate import TrainingSample
from fide_plugins.search.moves import Known, Start
from fide_plugins.search.scene import APART
from fide_plugins.types import Float64

_FEWEST = 8  # candidates that say how far parameters move
_PATIENCE = 3  # times that of other searches
_SMALLEST, _LARGEST = 0.01, 1.0  # standard deviation at the start, in units of sigma0
_LEAST_CHANGE = 0.05  # of D, that parameters can remove
_HYPOTHESES = 3  # remembered candidates that are rendered again, first
_AS_NEAR = 1.5  # times D: distance of the others of these


class _Distances(NamedTuple):
    """Of features (n, f) of remembered images from the old and the new picture, (n,) each."""

    old: Float64
    new: Float64
    features: Float64


@dataclass(frozen=True)
class Recalled:
    """What the memory says of a new picture.

    start: of the search.
    hypotheses: (m, d), remembered candidates whose images are near, the nearest first; or where the
        last search came to, if no image is remembered.
    samples: what proposers learn from, the least good first, with estimated losses.
    losses: (n,), estimated for all that is remembered.
    """

    start: Start
    hypotheses: Float64
    samples: list[TrainingSample]
    losses: Float64


def recall(
    samples: list[TrainingSample], known: Known, new: Tensor, popsize: int, learned: int
) -> Recalled:
    """Where to begin, by samples (at least one) with their losses to the old picture.

    known: of the scene, with the old target.  new: (T, C), tokens of the new one.
    learned: how many samples proposers learn from, at least one.
    """
    distances = _distances(samples, known.target, new, known.channels)
    losses = _estimated_losses(samples, distances)
    b = int(np.argmin(distances.new))
    x = _aligned(np.array([sample.x for sample in samples]), b, known)
    from_b = np.linalg.norm(distances.features - distances.features[b], axis=1)
    by_scale = _by_scale(from_b, _removable(distances, b))
    std = _spread(x, b, by_scale[: max(_FEWEST, popsize)], known)
    chosen = [b, *by_scale[: learned - 1]]
    chosen.sort(key=lambda i: -distances.new[i])
    taught = [replace(samples[i], x=x[i], loss=float(losses[i])) for i in chosen]
    start = Start(x[b], std, patience=_PATIENCE)
    return Recalled(start, _hypotheses(x, distances.new, known), taught, losses)


def _estimated_losses(samples: list[TrainingSample], distances: _Distances) -> Float64:
    """Losses (n,) to the new picture, of samples with their losses to the old one.

    An image gets the loss that images at its distance had to the old picture.
    """
    ordered = np.sort([sample.loss for sample in samples])
    places = np.searchsorted(np.sort(distances.old), distances.new)
    losses: Float64 = ordered[np.minimum(places, len(ordered) - 1)]
    return losses


def _distances(
    samples: list[TrainingSample], old: Tensor, new: Tensor, channels: int | None
) -> _Distances:
    features = np.stack([_features(sample.tokens, channels) for sample in samples])
    to_old = np.linalg.norm(features - _features(old, channels), axis=1)
    to_new = np.linalg.norm(features - _features(new, channels), axis=1)
    return _Distances(to_old, to_new, features)


def _features(tokens: Tensor, channels: int | None) -> Float64:
    seen = tokens.detach()[:, :channels].cpu().numpy()
    return np.asarray(seen, np.float64).ravel()


def _removable(distances: _Distances, b: int) -> float:
    """Part of D, the distance of image b, that parameters can be expected to remove.

    What no parameters can (R, the smallest distance to the old picture) was there before.
    """
    D, R = float(distances.new[b]), float(distances.old.min())
    return float(np.sqrt(max(D**2 - R**2, (_LEAST_CHANGE * D) ** 2)))


def _by_scale(from_b: Float64, scale: float) -> list[int]:
    """Candidates but b itself, those first whose images differ from that of b by about `scale`."""
    others = np.flatnonzero(from_b > 0)
    tiny = 1e-3 * float(np.median(from_b[others])) if len(others) else 1.0
    ratio = np.abs(np.log((from_b[others] + tiny) / (scale + tiny)))
    ordered: list[int] = others[np.argsort(ratio, kind="stable")].tolist()
    return ordered


def _aligned(x: Float64, b: int, known: Known) -> Float64:
    """Candidates (n, d) in the order of blocks that is nearest to candidate b."""
    exchangeable = known.exchangeability
    if exchangeable.blocks is None or exchangeable.ordered:
        return x
    return np.array([exchangeable.aligned(row, x[b]) for row in x])


def _spread(x: Float64, b: int, which: list[int], known: Known) -> Float64:
    """Standard deviations (d,): root mean square differences from b, within limits."""
    if not which:
        return _LARGEST * known.sigma0
    std = np.sqrt(np.square(known.axes.difference(x[which], x[b])).mean(axis=0))
    limits = _SMALLEST * known.sigma0, _LARGEST * known.sigma0
    clipped: Float64 = np.clip(std, *limits)
    return clipped


def _hypotheses(x: Float64, distances: Float64, known: Known) -> Float64:
    """Distinct candidates (m, d) whose images are about as near as the nearest, nearest first."""
    order = np.argsort(distances, kind="stable")
    near = order[distances[order] <= _AS_NEAR * distances[order[0]]]
    found = [x[near[0]]]
    for row in x[near[1:]]:
        if len(found) == _HYPOTHESES:
            break
        if min(known.exchangeability.distance(row, one) for one in found) >= APART:
            found.append(row)
    return np.array(found)
