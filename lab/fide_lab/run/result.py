"""Result of a run of the laboratory, judged without noise where the task can."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fide_plugins.recording.record import SUMMARY, Record, finite
from fide_plugins.space import Space
from fide_plugins.status import Status
from fide_plugins.types import Float32, Float64


@dataclass(frozen=True, eq=False)
class RunResult:
    """Result and cost of a run; times in seconds, without interruptions.

    seed, task_seed: of the optimizer and the target; None for a picture of the user's.
    budget, evaluations: renders that were allowed, and done.
    dim: number of coordinates; parameters: a choice of three values is one, and has three of them.
    losses, seconds: (evaluations,), in the order of evaluation; seconds since the start.
    best_loss: lowest loss, biased low for a noisy task; best_evaluation: its index, from 0.
    reference_loss, mse, recommended_loss: see `Verdict`.
    wall_s: without the noise-free evaluation after it and metrics.  times: by `PARTS`.
    x_best, x_recommended: (dim,); image: (H, W, 3), render of x_best; reference: its noise-free
        image; first_image: first render.  None where there is none.
    improvements: (m,), indices of evaluations that were the best so far; metrics: other losses of
        these by name, (m,); judged: other losses of the reference image.
    status: what the optimizer knows of the run; params: of x_best; None where unknown.
    """

    task: str
    optimizer: str
    loss: str
    seed: int
    task_seed: int | None
    dim: int
    parameters: int
    budget: int
    evaluations: int
    best_loss: float
    best_evaluation: int
    reference_loss: float
    recommended_loss: float
    mse: float
    wall_s: float
    times: dict[str, float]
    x_best: Float64 | None
    x_recommended: Float64 | None
    image: Float32 | None
    reference: Float32 | None
    first_image: Float32 | None
    losses: Float64
    seconds: Float64
    improvements: npt.NDArray[np.int64]
    metrics: dict[str, Float64]
    judged: dict[str, float]
    status: Status | None = None
    params: dict[str, Any] | None = None

    @property
    def render_s(self) -> float:
        """Seconds spent rendering."""
        return self.times["render"]

    @property
    def overhead_s(self) -> float:
        """Seconds spent on anything but rendering."""
        return self.wall_s - self.times["render"]

    @property
    def noisy(self) -> bool:
        """Whether the reference image of the best candidate differs from its render."""
        both = self.image is not None and self.reference is not None
        return both and not np.array_equal(self.image, self.reference)  # type: ignore[arg-type]

    def summary(self) -> dict[str, Any]:
        """Totals for JSON; numbers that are not finite become None."""
        return {key: getattr(self, key) for key in SUMMARY} | {
            "best_loss": finite(self.best_loss),
            "mse": finite(self.mse),
            "x_best": None if self.x_best is None else self.x_best.tolist(),
        }

    def totals(self) -> dict[str, Any]:
        """The same, with the noise-free evaluation, and times by part."""
        recommended = self.x_recommended
        return {
            **self.summary(),
            "reference_loss": finite(self.reference_loss),
            "recommended_loss": finite(self.recommended_loss),
            "x_recommended": None if recommended is None else recommended.tolist(),
            "judged": {name: finite(value) for name, value in self.judged.items()},
            "best_evaluation": self.best_evaluation,
            "times": self.times,
            **({} if self.params is None else {"params": self.params}),
            **({} if self.status is None else self.status.to_dict()),
        }


@dataclass(frozen=True, eq=False)
class Verdict:
    """Noise-free losses of the best candidate and of the recommended candidate.

    image: (H, W, 3) of the best candidate: the task's reference, or the render of the run.
    loss, mse, metrics: loss of the run, mean squared error and other losses of that image.
    x_recommended: (dim,); recommended_loss: of its reference; None and NaN without a reference.
    """

    image: Float32 | None = None
    loss: float = np.nan
    mse: float = np.nan
    x_recommended: Float64 | None = None
    recommended_loss: float = np.nan
    metrics: dict[str, float] = field(default_factory=dict)


def result_of(
    settings: Mapping[str, Any],
    record: Record,
    verdict: Verdict,
    *,
    budget: int,
    status: Status | None = None,
    space: object = None,
) -> RunResult:
    """Result of a run with these `settings`, as its directory records them.

    space: names of the parameters, where the settings do not have it.
    """
    r, s = record, settings
    there = None if s.get("space") is None else Space.from_dict(s["space"])
    names = there or space
    params = names.decode(r.x_best) if r.x_best is not None and isinstance(names, Space) else None
    same = ("task", "optimizer", "loss", "seed", "task_seed", "dim")
    copied = ("evaluations", "best_loss", "best_evaluation", "wall_s", "image", "first_image")
    return RunResult(
        **{name: s[name] for name in same},
        **{name: getattr(r, name) for name in copied},
        parameters=int(s["dim"]) if there is None else len(there.names),  # else of each coordinate
        budget=budget,
        reference_loss=verdict.loss,
        recommended_loss=verdict.recommended_loss,
        mse=verdict.mse,
        times=dict(r.times),
        x_best=None if r.x_best is None else r.x_best.copy(),
        x_recommended=verdict.x_recommended,
        reference=verdict.image,
        losses=np.array(r.losses),
        seconds=np.array(r.seconds),
        improvements=np.array(r.improvements, np.int64),
        metrics={name: np.array(values) for name, values in r.metrics.items()},
        judged=dict(verdict.metrics),
        status=status,
        params=params,
    )
