"""The result of a run, from its record and its noise-free evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fide_plugins.recording.record import Record, RunResult
from fide_plugins.space import Space
from fide_plugins.status import Status
from fide_plugins.types import Float32, Float64

__all__ = ["Verdict", "result_of"]


@dataclass(frozen=True, eq=False)
class Verdict:
    """Noise-free losses of the best candidate and of the recommended candidate.

    image: (H, W, 3) of the best candidate: the task's reference or, if the task has none, the
        render of the run; None if there is no best candidate.
    loss, mse: loss of the run and mean squared error of that image; NaN without an image.
    x_recommended: (dim,), recommended by the optimizer; None if the task has no `reference`.
    recommended_loss: loss of its reference; NaN if the task has no `reference`.
    metrics: other losses of the image by name.
    seconds: duration of the evaluation.
    """

    image: Float32 | None = None
    loss: float = np.nan
    mse: float = np.nan
    x_recommended: Float64 | None = None
    recommended_loss: float = np.nan
    metrics: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0


def result_of(
    settings: Mapping[str, Any],
    record: Record,
    verdict: Verdict,
    *,
    budget: int,
    samples: int | None = None,
    status: Status | None = None,
    space: object = None,
) -> RunResult:
    """Result of a run with these `settings`, as its directory records them.

    space: names of the parameters, where the settings do not have it.
    """
    r, s = record, settings
    there = None if s.get("space") is None else Space.from_dict(s["space"])
    return RunResult(
        task=s["task"],
        optimizer=s["optimizer"],
        loss=s["loss"],
        seed=s["seed"],
        task_seed=s["task_seed"],
        dim=s["dim"],
        parameters=int(s["dim"]) if there is None else len(there.names),  # else of each coordinate
        budget=budget,
        evaluations=r.evaluations,
        best_loss=r.best_loss,
        best_evaluation=r.best_evaluation,
        reference_loss=verdict.loss,
        recommended_loss=verdict.recommended_loss,
        mse=verdict.mse,
        wall_s=r.wall_s,
        judge_s=verdict.seconds,
        watch_s=r.watch_s,
        times=dict(r.times),
        x_best=None if r.x_best is None else r.x_best.copy(),
        x_recommended=verdict.x_recommended,
        image=r.image,
        reference=verdict.image,
        first_image=r.first_image,
        losses=np.array(r.losses),
        seconds=np.array(r.seconds),
        improvements=np.array(r.improvements, np.int64),
        metrics={name: np.array(values) for name, values in r.metrics.items()},
        judged=dict(verdict.metrics),
        generations=_evaluated(np.array(r.generations, np.int64), r.evaluations),
        samples=samples,
        status=status,
        params=_params(there or space, r.x_best),
    )


def _params(space: object, x: Float64 | None) -> dict[str, Any] | None:
    return None if x is None or not isinstance(space, Space) else space.decode(x)


def _evaluated(asked: NDArray[np.int64], evaluations: int) -> NDArray[np.int64]:
    """Sizes of the generations, of which the last candidates may be pending, without those."""
    before = np.cumsum(asked) - asked
    sizes: NDArray[np.int64] = np.minimum(asked, evaluations - before)[before < evaluations]
    return sizes
