"""What a run knows of itself: progress, totals, the history of its losses.

Notation: a *piece* is what is rendered and told at once; *overhead* is all time but rendering.
"""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fide_plugins.harness.parallel import rounds
from fide_plugins.images import Float32
from fide_plugins.points import Float64

__all__ = ["PARTS", "Keep", "Progress", "Record", "RunResult"]

PARTS = ("render", "encode", "train", "search")
"""What time is spent on; encode includes the loss."""


@dataclass(frozen=True)
class Keep:
    """What a run records beside every evaluation's loss; none of it counts as time of the run.

    metrics: names of losses by which every image that improves on the best loss is measured too.
    film: the best image so far after 1, 3, 10, 30, ... renders, small; needs a run directory.
    summary: a picture of the whole run, summary.png.
    checkpoint: the state of a run that is finished, which nothing needs any more.
    """

    metrics: tuple[str, ...] = ()
    film: bool = False
    summary: bool = True
    checkpoint: bool = True


@dataclass(frozen=True)
class Progress:
    """A run at one moment.

    evaluations, budget: renders done and allowed.
    best_loss: lowest loss so far; infinity before there is a finite one.
    wall_s: seconds so far, interruptions left out.
    times: seconds of it, by `PARTS`; the rest is the loop's own.
    """

    evaluations: int
    budget: int
    best_loss: float
    wall_s: float
    times: dict[str, float]


@dataclass(frozen=True, eq=False)
class RunResult:
    """What a run found, and what it took.

    Times are in seconds and leave interruptions out; `overhead_s` is all but rendering.  The result
    is judged after the run, which is counted in `judge_s` alone, and what is kept beside the losses
    is counted in `watch_s` alone.
    losses, seconds: (evaluations,), in the order of evaluation; seconds since the start.
    best_loss: the lowest of the losses; of a noisy task, low by luck too.
    reference_loss, mse: of the best candidate's reference image, by the run's loss and as mean
        squared error; of `image` where the task has no reference.
    recommended_loss: of the reference image of the optimizer's recommendation; NaN without one.
    x_best, x_recommended: (dim,); image: (H, W, 3) of x_best as it was rendered during the run;
        reference: (H, W, 3), the image of x_best that was judged.  They are None if no candidate
        had a finite loss.
    first_image: (H, W, 3), the first render of all.
    improvements: (m,), evaluations that were the best so far, from 0.
    metrics: by name, (m,): what other losses say of the images of these.
    judged: by name, what they say of the reference image.
    generations: (g,), numbers of candidates that were asked at once.
    samples: of a pixel, taken in all renders together, where their number rises; else None.
    """

    task: str
    optimizer: str
    loss: str
    seed: int
    task_seed: int | None
    dim: int
    budget: int
    evaluations: int
    best_loss: float
    best_evaluation: int
    reference_loss: float
    recommended_loss: float
    mse: float
    wall_s: float
    judge_s: float
    watch_s: float
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
    generations: npt.NDArray[np.int64]
    samples: int | None = None

    @property
    def render_s(self) -> float:
        """Seconds spent rendering."""
        return self.times["render"]

    @property
    def overhead_s(self) -> float:
        """Seconds spent on anything but rendering."""
        return self.wall_s - self.times["render"]

    def summary(self) -> dict[str, Any]:
        """Totals as JSON can hold them: what is not finite becomes None."""
        return {
            "task": self.task,
            "optimizer": self.optimizer,
            "loss": self.loss,
            "seed": self.seed,
            "task_seed": self.task_seed,
            "dim": self.dim,
            "budget": self.budget,
            "evaluations": self.evaluations,
            "best_loss": _finite(self.best_loss),
            "mse": _finite(self.mse),
            "wall_s": self.wall_s,
            "render_s": self.render_s,
            "overhead_s": self.overhead_s,
            "x_best": None if self.x_best is None else self.x_best.tolist(),
        }

    def details(self) -> dict[str, Any]:
        """What else is worth recording, as JSON can hold it: the judgment, and the times."""
        recommended = self.x_recommended
        return {
            "reference_loss": _finite(self.reference_loss),
            "recommended_loss": _finite(self.recommended_loss),
            "x_recommended": None if recommended is None else recommended.tolist(),
            "judged": {name: _finite(value) for name, value in self.judged.items()},
            "best_evaluation": self.best_evaluation,
            "rounds": int(rounds(self.generations)[-1]) if len(self.generations) else 0,
            "judge_s": self.judge_s,
            "watch_s": self.watch_s,
            "times": self.times,
            **({} if self.samples is None else {"samples": self.samples}),
        }


@dataclass
class Record:
    """Everything a run has seen; it can be stored and restored.

    losses, seconds: one entry for each evaluation.
    improvements: evaluations that were the best so far; metrics: one entry for each of these.
    generations: sizes of what was asked at once.
    pending: (m, dim), candidates that were asked and not yet told.
    fidelity: state of the samples of a pixel, where they rise.
    """

    losses: array[float] = field(default_factory=lambda: array("d"))
    seconds: array[float] = field(default_factory=lambda: array("d"))
    improvements: array[int] = field(default_factory=lambda: array("q"))
    metrics: dict[str, array[float]] = field(default_factory=dict)
    generations: array[int] = field(default_factory=lambda: array("q"))
    times: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))
    wall_s: float = 0.0
    watch_s: float = 0.0
    best_loss: float = math.inf
    best_evaluation: int = -1
    x_best: Float64 | None = None
    image: Float32 | None = None
    first_image: Float32 | None = None
    pending: Float64 | None = None
    fidelity: dict[str, Any] | None = None

    @property
    def evaluations(self) -> int:
        """Renders so far."""
        return len(self.losses)

    def add(self, X: Float64, images: Float32, losses: Float64) -> list[int]:
        """Count a piece: candidates (n, dim), images (n, H, W, 3), losses (n,).

        Returns the places in it at which the best loss so far fell.
        """
        if self.first_image is None:
            self.first_image = images[0].copy()
        ranked = np.where(np.isfinite(losses), losses, np.inf)
        before = np.minimum.accumulate(np.concatenate([[self.best_loss], ranked[:-1]]))
        improved: list[int] = np.flatnonzero(ranked < before).tolist()
        if improved:
            winner = improved[-1]
            self.best_loss = float(ranked[winner])
            self.best_evaluation = self.evaluations + winner
            self.x_best, self.image = X[winner].copy(), images[winner].copy()
        self.improvements.extend(self.evaluations + i for i in improved)
        self.losses.extend(losses.tolist())
        self.seconds.extend([self.wall_s] * len(losses))
        return improved

    def judge_again(self, image: Float32, loss: float) -> None:
        """Put another render of the best candidate in the place of its image and loss."""
        self.image, self.best_loss = image.copy(), loss if math.isfinite(loss) else math.inf

    def state(self) -> dict[str, Any]:
        """Everything, for a checkpoint."""
        fields: dict[str, Any] = dict(vars(self))
        arrays = {key: np.array(fields[key], kind) for key, kind in _ARRAYS.items()}
        metrics = {name: np.array(values) for name, values in self.metrics.items()}
        return {**fields, **arrays, "metrics": metrics}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> Record:
        """The record of which `state` was made."""
        arrays = {key: array(kind, state[key].tolist()) for key, kind in _ARRAYS.items()}
        metrics = {name: array("d", values.tolist()) for name, values in state["metrics"].items()}
        return cls(**{**state, **arrays, "metrics": metrics})


_ARRAYS = {"losses": "d", "seconds": "d", "improvements": "q", "generations": "q"}
"""Arrays of a record, and the code of their type, for `array` and for NumPy."""


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
