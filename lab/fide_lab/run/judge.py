"""Noise-free evaluation of the result of a run.

The lowest of many noisy losses is biased low.  So the best candidate, and the candidate that the
optimizer recommends, are rendered again by the task's `reference`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fide_plugins import losses as losses_module
from fide_plugins.losses.base import ImageLoss
from fide_plugins.recording.outcome import Verdict
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.images import as_target

__all__ = ["judge"]


def judge(
    reference: Callable[[Float64], Any] | None,
    target: Float32,
    loss: ImageLoss,
    x_best: Float64 | None,
    image: Float32 | None,
    x_recommended: Float64 | None = None,
    metrics: Mapping[str, ImageLoss] | None = None,
) -> Verdict:
    """Evaluate the best candidate and, if given, the recommended candidate.

    reference: of the task, see `TaskInfo`.
    metrics: other losses by name, for the best one.
    """
    start = time.perf_counter()
    if x_best is None or image is None:
        return Verdict()
    best = image if reference is None else as_target(reference(x_best))
    value, others = _loss(loss, best), {k: _loss(m, best) for k, m in (metrics or {}).items()}
    if reference is None:
        return Verdict(best, value, _mse(target, best), metrics=others)
    recommended = value
    if x_recommended is not None and not np.array_equal(x_recommended, x_best):
        recommended = _loss(loss, as_target(reference(x_recommended)))
    seconds = time.perf_counter() - start
    return Verdict(best, value, _mse(target, best), x_recommended, recommended, others, seconds)


def _loss(loss: ImageLoss, image: Float32) -> float:
    return float(loss.compute(image[None])[0])


def _mse(target: Float32, image: Float32) -> float:
    return float(losses_module.make("mse", target)(image[None])[0])
