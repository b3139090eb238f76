"""Progress, history and result of a run."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from fide_plugins.runtime.schema import (
    Schema,
    anything,
    array as numbers,
    check,
    each,
    maybe,
    real,
    row,
    table,
    whole,
)
from fide_plugins.space import Space
from fide_plugins.status import Status
from fide_plugins.types import Float32, Float64, Optimizer, Solution

PARTS = ("render", "encode", "train", "search")
"""Parts of the time of a run; encode includes the loss."""

SUMMARY = (
    *("task", "optimizer", "loss", "seed", "task_seed", "dim", "budget", "evaluations"),
    *("best_loss", "mse", "wall_s", "render_s", "overhead_s", "x_best"),
)
"""Keys of `RunResult.summary`, which are names of its attributes."""


@dataclass(frozen=True)
class Progress:
    """Progress of a run.

    evaluations, budget: renders done and allowed.  best_loss: infinity before the first finite one.
    wall_s: seconds so far, without interruptions; times: by `PARTS`; time: that are allowed.
    remark: such as "3 rendering, 1 failed".
    """

    evaluations: int
    budget: int
    best_loss: float
    wall_s: float
    times: dict[str, float]
    remark: str = ""
    time: float | None = None


Report: TypeAlias = Callable[[Progress], object]
"""Function that shows the progress of a run; what it returns does not matter."""


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
            "best_loss": _finite(self.best_loss),
            "mse": _finite(self.mse),
            "x_best": None if self.x_best is None else self.x_best.tolist(),
        }

    def details(self) -> dict[str, Any]:
        """Further totals for JSON: the noise-free evaluation, and times by part."""
        recommended = self.x_recommended
        return {
            "reference_loss": _finite(self.reference_loss),
            "recommended_loss": _finite(self.recommended_loss),
            "x_recommended": None if recommended is None else recommended.tolist(),
            "judged": {name: _finite(value) for name, value in self.judged.items()},
            "best_evaluation": self.best_evaluation,
            "times": self.times,
            **({} if self.params is None else {"params": self.params}),
            **({} if self.status is None else self.status.to_dict()),
        }


@dataclass
class Record:
    """History of a run; it can be saved and restored.

    losses, seconds: one entry for each evaluation.
    improvements: evaluations that were the best so far; metrics: one entry for each improvement.
    path: (dim,), point of each improvement; shorter for a run that an earlier version began.
    pending: (m, dim), candidates that were asked and not yet told.
    failures: renders that gave no image, where a run survives them.
    fineness: state of a `fitting.schedule`; None where all renders are of one kind.
    """

    losses: array[float] = field(default_factory=lambda: array("d"))
    seconds: array[float] = field(default_factory=lambda: array("d"))
    improvements: array[int] = field(default_factory=lambda: array("q"))
    path: list[Float64] = field(default_factory=list)
    metrics: dict[str, array[float]] = field(default_factory=dict)
    times: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))
    wall_s: float = 0.0
    best_loss: float = math.inf
    best_evaluation: int = -1
    x_best: Float64 | None = None
    image: Float32 | None = None
    first_image: Float32 | None = None
    pending: Float64 | None = None
    failures: int = 0
    fineness: dict[str, Any] | None = None

    @property
    def evaluations(self) -> int:
        """Renders so far."""
        return len(self.losses)

    @property
    def cost(self) -> float:
        """Of all renders so far, in renders of full size and samples."""
        return float(self.evaluations if self.fineness is None else self.fineness["cost"])

    @property
    def best(self) -> Solution | None:
        """The best candidate; None before the first finite loss."""
        if self.x_best is None:
            return None
        return Solution(self.x_best.copy(), self.best_loss, self.best_evaluation)

    def add(self, X: Float64, images: Float32, losses: Float64) -> list[int]:
        """Add candidates (n, dim), images (n, H, W, 3), losses (n,); indices of improvements."""
        told = zip(X, images, losses.tolist(), strict=True)
        return [i for i, one in enumerate(told) if self.add_one(*one)]

    def add_one(self, x: Float64, image: Float32 | None, loss: float) -> bool:
        """Add a candidate (dim,) with its image (H, W, 3); returns whether it is the best so far.

        image: None where it is neither the first one nor the best.
        """
        if self.first_image is None and image is not None:
            self.first_image = image.copy()
        improved = loss < self.best_loss and math.isfinite(loss)
        if improved and image is not None:
            self.best_loss, self.best_evaluation = loss, self.evaluations
            self.x_best, self.image = x.copy(), image.copy()
            self.improvements.append(self.evaluations)
            self.path.append(self.x_best.copy())
        self.losses.append(loss)
        self.seconds.append(self.wall_s)
        return improved

    def keep_only(self, best: Solution) -> None:
        """Replace the best candidate, after images began to be compared in another way.

        All other losses are of the old comparison, and become infinite.
        """
        self.best_loss, self.best_evaluation = best.loss, best.evaluation
        self.x_best, self.image = best.x.copy(), best.image
        self.losses = array("d", [math.inf]) * self.evaluations
        self.losses[best.evaluation] = best.loss
        self.improvements, self.path = array("q", [best.evaluation]), [best.x.copy()]

    @contextmanager
    def timing(self, optimizer: Optimizer) -> Iterator[None]:
        """Enter the time of a step of the optimizer, split by the optimizer's own record."""
        before, start = dict(optimizer.times), time.perf_counter()
        yield
        elapsed = time.perf_counter() - start
        for part in ("encode", "train"):
            spent = optimizer.times.get(part, 0.0) - before.get(part, 0.0)
            self.times[part] += spent
            elapsed -= spent
        self.times["search"] += max(0.0, elapsed)

    def progress(self, budget: int) -> Progress:
        """Progress towards a budget; 0 where there is none."""
        return Progress(self.evaluations, budget, self.best_loss, self.wall_s, dict(self.times))

    def state(self) -> dict[str, Any]:
        """State for a checkpoint."""
        fields: dict[str, Any] = dict(vars(self))
        if self.fineness is None:
            del fields["fineness"]
        arrays = {key: np.array(fields[key], kind) for key, kind in _ARRAYS.items()}
        metrics = {name: np.array(values) for name, values in self.metrics.items()}
        path = np.array(self.path).reshape(len(self.path), -1 if self.path else 0)
        return {**fields, **arrays, "metrics": metrics, "path": path}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> Record:
        """Record with a state that `state` returned."""
        arrays = {key: array(kind, state[key].tolist()) for key, kind in _ARRAYS.items()}
        metrics = {name: array("d", values.tolist()) for name, values in state["metrics"].items()}
        return cls(**{**state, **arrays, "metrics": metrics, "path": list(state["path"])})


_ARRAYS = {"losses": "d", "seconds": "d", "improvements": "q"}
"""Array fields of a record, and their type codes for `array` and for NumPy."""


def best_so_far(losses: npt.ArrayLike) -> Float64:
    """Lowest of the losses (n,) up to each, (n,); infinity before the first finite one."""
    known = np.asarray(losses, np.float64)
    best: Float64 = np.minimum.accumulate(np.where(np.isfinite(known), known, np.inf))
    return best


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


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


_IMAGE = maybe(numbers("H", "W", 3, low=0.0, high=1.0))
_FINENESS: Schema = {
    **dict.fromkeys(("k", "samples", "_count", "_since", "_told", "_best_at"), whole()),
    **{name: numbers(name, low=None) for name in ("_halves", "_spreads", "_losses")},
    "cost": real(),
    "_best": real(high=math.inf),
    "_typical": maybe(real()),
    "_spread": maybe(numbers("d", low=0.0)),
    "works": each(whole()),
    "sizes": each(each(anything)),
    "rising": maybe(row(numbers("d", low=0.0, high=1.0), numbers("d", low=0.0))),
}
_RECORD: dict[str, Schema] = {
    "losses": numbers("e", low=None),
    "seconds": numbers("e", low=0.0),
    "improvements": numbers("m", kind="i", low=0.0),
    "path": numbers("k", "d", low=0.0, high=1.0),
    "metrics": table(numbers("m", low=None)),
    "times": dict.fromkeys(PARTS, real()),
    "wall_s": real(),
    "best_loss": real(high=math.inf),
    "best_evaluation": whole(-1),
    "x_best": maybe(numbers("d", low=0.0, high=1.0)),
    "image": _IMAGE,
    "first_image": _IMAGE,
    "pending": maybe(numbers("p", "d", low=0.0, high=1.0)),
    "failures": whole(),
}


def check_record(state: Any, dim: int, size: Sequence[int]) -> None:
    """Raise ValueError unless `state` is valid for a run of `dim` parameters and size (H, W)."""
    sides = {"d": dim, "H": size[0], "W": size[1]}
    schema = {**_RECORD, "fineness": _FINENESS} if "fineness" in state else _RECORD
    check(state, schema, sides, "record")
    if sides["m"] and int(state["improvements"].max()) >= sides["e"]:
        raise ValueError(f"an improvement after all {sides['e']} evaluations")
