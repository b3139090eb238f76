"""The result of a run, from its record and its noise-free evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fide_plugins.experiments.run.judge import Verdict
from fide_plugins.experiments.run.record import Record, RunResult

__all__ = ["result_of"]


def result_of(
    settings: Mapping[str, Any],
    record: Record,
    verdict: Verdict,
    *,
    budget: int,
    samples: int | None = None,
    status: str | None = None,
) -> RunResult:
    """Result of a run with these `settings`, as its directory records them."""
    r, s = record, settings
    return RunResult(
        task=s["task"],
        optimizer=s["optimizer"],
        loss=s["loss"],
        seed=s["seed"],
        task_seed=s["task_seed"],
        dim=s["dim"],
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
    )


def _evaluated(asked: NDArray[np.int64], evaluations: int) -> NDArray[np.int64]:
    """Sizes of the generations, of which the last candidates may be pending, without those."""
    before = np.cumsum(asked) - asked
    sizes: NDArray[np.int64] = np.minimum(asked, evaluations - before)[before < evaluations]
    return sizes
