"""Where the search for another picture begins, from what was rendered for earlier ones.

At the candidate b whose image is nearest to it, as wide as those candidates say whose images differ
from that of b by what is wrong with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from fide_plugins.population import TrainingSample
from fide_plugins.search.moves import Known, Start
from fide_plugins.search.scene import APART
from fide_plugins.types import Float64

_FEWEST = 8  # candidates that say how far parameters move
_PATIENCE = 3  # times that of other searches
_SMALLEST, _LARGEST = 0.01, 1.0  # standard deviation at the start, in units of sigma0
_LEAST_CHANGE = 0.05  # of D, that parameters can remove
_HYPOTHESES = 3  # remembered candidates that are rendered again, first
_AS_NEAR = 1.5  # times D: distance of the others of these


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
    features = np.stack([_features(sample.tokens, known.channels) for sample in samples])  # (n, f)
    from_old, from_new = (  # distances (n,)
        np.linalg.norm(features - _features(picture, known.channels), axis=1)
        for picture in (known.target, new)
    )
    # An image gets the loss that images at its distance had to the old picture.
    ordered = np.sort([sample.loss for sample in samples])
    places = np.searchsorted(np.sort(from_old), from_new)
    losses: Float64 = ordered[np.minimum(places, len(ordered) - 1)]
    b = int(np.argmin(from_new))
    x = np.array([sample.x for sample in samples])
    exchangeable = known.exchangeability
    if exchangeable.blocks is not None and not exchangeable.ordered:
        x = np.array([exchangeable.aligned(row, x[b]) for row in x])
    from_b = np.linalg.norm(features - features[b], axis=1)
    # What no parameters remove of the distance D of image b was there before, too.
    D, R = float(from_new[b]), float(from_old.min())
    removable = float(np.sqrt(max(D**2 - R**2, (_LEAST_CHANGE * D) ** 2)))
    by_scale = _by_scale(from_b, removable)
    std = _spread(x, b, by_scale[: max(_FEWEST, popsize)], known)
    chosen = [b, *by_scale[: learned - 1]]
    chosen.sort(key=lambda i: -from_new[i])
    taught = [replace(samples[i], x=x[i], loss=float(losses[i])) for i in chosen]
    start = Start(x[b], std, patience=_PATIENCE)
    return Recalled(start, _hypotheses(x, from_new, known), taught, losses)


def _features(tokens: Tensor, channels: int | None) -> Float64:
    seen = tokens.detach()[:, :channels].cpu().numpy()
    return np.asarray(seen, np.float64).ravel()


def _by_scale(from_b: Float64, scale: float) -> list[int]:
    """Candidates but b itself, those first whose images differ from that of b by about `scale`."""
    others = np.flatnonzero(from_b > 0)
    tiny = 1e-3 * float(np.median(from_b[others])) if len(others) else 1.0
    ratio = np.abs(np.log((from_b[others] + tiny) / (scale + tiny)))
    ordered: list[int] = others[np.argsort(ratio, kind="stable")].tolist()
    return ordered


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
        if min(known.exchangeability.distance(row, one, APART) for one in found) >= APART:
            found.append(row)
    return np.array(found)
