"""Which parameters images show, by the truth of held-out renders.

A model may be sure of what no image shows, so how sure it is decides nothing.  The samples of an
image say with which probability the truth is in each quarter of an axis.  The logarithm of that of
the quarter where it is, less that of the uniform density, is 0 on average where nothing was learned
(log score; Gneiting and Raftery 2007).  A parameter is shown if that mean is larger than chance.

Of exchangeable blocks none is the first, so all of them have one score.  The samples of each block
are judged by the block of the truth that is nearest *in the other axes*: one that is near in this
axis, too, would seem to have been found.  Or all blocks are judged together, by the quarters in
which any of them may be; that tells less, but needs no other axis.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from fide_plugins.search.mixed import distance
from fide_plugins.types import Float64, Indices, Mask

__all__ = ["are_shown", "of_any_block", "scores"]

_BINS = 4
_LEAST = 0.02  # nats: less is of no use, however surely it is there
_ERRORS = 1.645  # standard errors of a mean: chance makes as much in 5 %
_NUMBER = re.compile(r"(\[\d+\])(?=\.)")  # of a repeated group


def scores(samples: Float64, truth: Float64, periodic: Mask, blocks: Indices) -> Float64:
    """Log scores (2, d) in nats of the samples (n, d) of one image, given its truth (d,).

    periodic: (d,).  blocks: (m, L), axes of exchangeable blocks, which are judged each by itself,
    and then together; both rows are the same elsewhere.
    """
    counts = np.stack([(_quarters(samples) == k).sum(axis=0) for k in range(_BINS)], axis=1)
    p = (counts + 0.5) / (len(samples) + 0.5 * _BINS)  # (d, bins), never 0
    quarter = _quarters(truth)
    gain = np.log(p[np.arange(len(truth)), quarter] * _BINS)  # (d,)
    both = np.stack([gain, gain])
    if blocks.size:
        both[:, blocks] = _of_blocks(samples, truth, periodic, blocks, p, quarter)[:, None]
    return both


def _of_blocks(
    samples: Float64,
    truth: Float64,
    periodic: Mask,
    blocks: Indices,
    p: Float64,
    quarter: Indices,
) -> Float64:
    """Mean scores (2, L) of the blocks, each by itself and together; p (d, bins), quarter (d,)."""
    wraps = periodic[blocks[0]]
    apart = distance(samples[:, blocks][:, :, None], truth[blocks][None, None], wraps)
    cost = apart.mean(axis=0)  # (samples' blocks, the truth's blocks, L)
    alone, together = np.empty(len(wraps)), np.empty(len(wraps))
    for axis in range(len(wraps)):
        here = p[blocks[:, axis]]  # (m, bins)
        true = quarter[blocks[:, axis]]  # (m,)
        others = cost.sum(axis=2) - cost[:, :, axis]
        _, matched = linear_sum_assignment(others)
        alone[axis] = np.log(here[np.arange(len(here)), true[matched]] * _BINS).mean()
        together[axis] = np.log(here.mean(axis=0)[true] * _BINS).mean()
    return np.stack([alone, together])


def are_shown(scored: Float64, names: Sequence[str]) -> Mask:
    """Which axes (d,) belong to parameters that images show, by scores (n, 2, d) of n images.

    names: (d,), of the parameters.  One of several axes is enough, as of a choice.
    """
    mean = scored.mean(axis=0)
    n = len(scored)
    error = scored.std(axis=0, ddof=1) / np.sqrt(n) if n > 1 else np.zeros_like(mean)
    shown = ((mean >= _LEAST) & (mean >= _ERRORS * error)).any(axis=0)
    known = {name for name, each in zip(names, shown, strict=True) if each}
    return np.array([name in known for name in names])


def of_any_block(names: Sequence[str], blocks: Indices) -> list[str]:
    """Names (d,) without the number of an exchangeable block: "lamps.x" for "lamps[2].x".

    blocks: (m, L), axes.  Names that differ in more than such numbers stay as they are.
    """
    found = list(names)
    for axes in blocks.T.tolist() if blocks.size else []:
        parts = [_NUMBER.split(names[axis]) for axis in axes]
        if len({tuple(part[::2]) for part in parts}) > 1:
            continue
        same = [len(set(column)) == 1 for column in zip(*parts, strict=True)]
        name = "".join(part for part, kept in zip(parts[0], same, strict=True) if kept)
        for axis in axes:
            found[axis] = name
    return found


def _quarters(x: Float64) -> Indices:
    """Quarter 0 to 3 of each coordinate."""
    return np.minimum((x * _BINS).astype(np.intp), _BINS - 1)
