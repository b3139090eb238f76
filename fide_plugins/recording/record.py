"""Progress and history of a run."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from fide_plugins.runtime.schema import (
    Schema,
    anything,
    array as numbers,
    check,
    each,
    form,
    maybe,
    real,
    row,
    saved,
    table,
    whole,
)
from fide_plugins.types import Float32, Float64, Optimizer, Solution

PARTS = ("render", "encode", "train", "search")
"""Parts of the time of a run; encode includes the loss."""

SUMMARY = (
    *("task", "optimizer", "loss", "seed", "task_seed", "dim", "budget", "evaluations"),
    *("best_loss", "mse", "wall_s", "render_s", "overhead_s", "x_best"),
)
"""Keys of the totals that `fide fit --json` and `fide run --json` print."""


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


@dataclass
class Record:
    """History of a run; it can be saved and restored.

    losses, seconds: of each evaluation.  improvements: those that were the best so far; metrics,
    path: of each of these.  pending: (m, dim), candidates that were asked and not yet told.
    failures: renders that gave no image.  fineness: state of a `fitting.schedule`, if there is one.
    """

    losses: array[float] = saved(numbers("e", low=None), default_factory=lambda: array("d"))
    seconds: array[float] = saved(numbers("e", low=0.0), default_factory=lambda: array("d"))
    improvements: array[int] = saved(
        numbers("m", kind="i", low=0.0), default_factory=lambda: array("q")
    )
    path: list[Float64] = saved(numbers("k", "d", low=0.0, high=1.0), default_factory=list)
    metrics: dict[str, array[float]] = saved(table(numbers("m", low=None)), default_factory=dict)
    times: dict[str, float] = saved(
        dict.fromkeys(PARTS, real()), default_factory=lambda: dict.fromkeys(PARTS, 0.0)
    )
    wall_s: float = saved(real(), default=0.0)
    best_loss: float = saved(real(high=math.inf), default=math.inf)
    best_evaluation: int = saved(whole(-1), default=-1)
    x_best: Float64 | None = saved(maybe(numbers("d", low=0.0, high=1.0)), default=None)
    image: Float32 | None = saved(_IMAGE, default=None)
    first_image: Float32 | None = saved(_IMAGE, default=None)
    pending: Float64 | None = saved(maybe(numbers("p", "d", low=0.0, high=1.0)), default=None)
    failures: int = saved(whole(), default=0)
    fineness: dict[str, Any] | None = saved(_FINENESS, default=None)

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
        """Add a candidate (dim,), with its image if it may be best; whether it is the best."""
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
        """Replace the best after images are compared in another way: other losses are lost."""
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


def finite(value: float) -> float | None:
    """The value, as JSON has it: None for NaN and infinity."""
    return float(value) if math.isfinite(value) else None


def totals_of(
    settings: Mapping[str, Any], record: Record, *, budget: int, mse: float
) -> dict[str, Any]:
    """Totals of a run with these settings, for JSON: those of `SUMMARY`, and some more."""
    r, same = record, ("task", "optimizer", "loss", "seed", "task_seed", "dim")
    return {
        **{name: settings[name] for name in same},
        "budget": budget,
        "evaluations": r.evaluations,
        "best_loss": finite(r.best_loss),
        "mse": finite(mse),
        "wall_s": r.wall_s,
        "render_s": r.times["render"],
        "overhead_s": r.wall_s - r.times["render"],
        "x_best": None if r.x_best is None else r.x_best.tolist(),
        "best_evaluation": r.best_evaluation,
        "times": r.times,
    }


def check_record(state: Any, dim: int, size: Sequence[int]) -> None:
    """Raise ValueError unless `state` is valid for a run of `dim` parameters and size (H, W)."""
    sides = {"d": dim, "H": size[0], "W": size[1]}
    schema = form(Record)
    if "fineness" not in state:
        del schema["fineness"]
    check(state, schema, sides, "record")
    if sides["m"] and int(state["improvements"].max()) >= sides["e"]:
        raise ValueError(f"an improvement after all {sides['e']} evaluations")
