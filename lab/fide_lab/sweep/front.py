"""Results of a sweep: loss of each combination for a cost in seconds or renders; Pareto front.

Losses during a run can be compared if all images have the same size and no noise.  If the sweep
has several sizes or numbers of samples per pixel, or if images are noisy, a run counts only from
its end, with the loss of its best candidate at the largest size and without noise.  A user's
renderer has no image without noise; whether it is noisy is not known, and its losses count as seen.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fide_lab.compare import Results, StoredRun, read as read_comparison
from fide_lab.compare.configuration import split
from fide_lab.compare.plan import target_file
from fide_lab.compare.results import NoResultsError
from fide_lab.run.prepare import make_task, target_of
from fide_lab.run.renderer_task import is_own
from fide_lab.run.task import Task, TaskInfo
from fide_plugins import losses as losses_module
from fide_plugins.recording import kept_target
from fide_plugins.types import Float32

__all__ = ["AXES", "MARKS", "Combination", "Point", "best_within", "front", "read"]

AXES = ("seconds", "renders")
MARKS = 60
"""Number of geometrically spaced costs at which a run is evaluated."""


class Point(NamedTuple):
    """Loss of a combination at a cost in seconds or renders."""

    cost: float
    loss: float
    combination: Combination


@dataclass(frozen=True, eq=False)
class Combination:
    """One combination of options on one task.

    name: label of the optimizer configuration; size, spp: task options, None where the task has
        none: a user's renderer has its own size.
    runs: finished runs; finals: their final losses, (n,), comparable within the task.
    anytime: whether losses during the runs are comparable too.
    """

    task: str
    name: str
    size: int | None
    spp: int | None
    runs: tuple[StoredRun, ...]
    finals: tuple[float, ...]
    anytime: bool

    @property
    def words(self) -> tuple[str, ...]:
        """The preset and the other options: "balanced", "popsize=30", "size=112"."""
        options = dict(word.split("=", 1) for word in split(self.name)[1])
        of_task = {"size": self.size, "spp": self.spp}
        options |= {name: str(value) for name, value in of_task.items() if value is not None}
        preset = options.pop("preset")
        return (preset, *(f"{name}={value}" for name, value in options.items()))

    @property
    def label(self) -> str:
        """Preset and options as one text."""
        return " ".join(self.words)

    def end(self, axis: str) -> float:
        """Median cost of a complete run."""
        return float(np.median([run.curve.ends[axis] for run in self.runs if run.curve]))

    @property
    def final(self) -> float:
        """Median final loss of the runs."""
        return float(np.median(self.finals))

    def loss_at(self, axis: str, cost: float) -> float:
        """Median loss for a cost; infinity if there is no loss yet."""
        return float(np.median([self._of_run(i, axis, cost) for i in range(len(self.runs))]))

    def _of_run(self, i: int, axis: str, cost: float) -> float:
        curve = self.runs[i].curve
        assert curve is not None  # all runs are finished
        if cost >= curve.ends[axis]:
            return self.finals[i]
        return curve.loss_at(axis, cost) if self.anytime else np.inf

    def points(self, axis: str) -> list[Point]:
        """Points along the runs if `anytime`; otherwise one point at their end.

        Only those of finite loss: a run without any is infinite all along.
        """
        curves = [run.curve for run in self.runs if run.curve]
        starts = [curve.at[axis][0] for curve in curves if len(curve.loss)]
        if not self.anytime:
            found = [Point(self.end(axis), self.final, self)]
        elif starts:
            longest = max(curve.ends[axis] for curve in curves)
            marks = np.geomspace(max(min(starts), 1e-6), longest, MARKS).tolist()
            found = [Point(cost, self.loss_at(axis, cost), self) for cost in marks]
        else:
            found = []
        return [point for point in found if np.isfinite(point.loss)]


def front(combinations: Iterable[Combination], axis: str) -> list[Point]:
    """Pareto front: points that no other beats in both cost and loss, by increasing cost."""
    points = [point for each in combinations for point in each.points(axis)]
    kept: list[Point] = []
    for point in sorted(points, key=lambda p: (p.cost, p.loss)):
        if not kept or point.loss < kept[-1].loss:
            kept.append(point)
    return kept


def best_within(combinations: Sequence[Combination], axis: str, cost: float) -> Point | None:
    """Lowest loss for a cost, on a tie the cheapest combination; None if no loss is known."""
    found = [Point(cost, each.loss_at(axis, cost), each) for each in combinations]
    known = [point for point in found if np.isfinite(point.loss)]
    return min(known, key=lambda p: (p.loss, p.combination.end(axis)), default=None)


def read(out: Path) -> list[Combination]:
    """Read all combinations that have a finished run in the folder of a sweep.

    Raises NoResultsError (a FileNotFoundError) if there is none.
    """
    results = [read_comparison(path.parent) for path in sorted(out.glob("*/study.json"))]
    kinds = {(r.settings["size"], _spp(r)) for r in results}
    judge = _Judge(results) if len(kinds) > 1 else None
    combinations = [each for result in results for each in _combinations(result, judge)]
    if not combinations:
        raise NoResultsError(f"{out} holds no finished run of a sweep; run: fide tradeoff --resume")
    return combinations


def _combinations(results: Results, judge: _Judge | None) -> list[Combination]:
    finished: dict[tuple[str, str], list[StoredRun]] = {}
    for run in results.runs:
        if run.curve is not None:
            finished.setdefault((run.key.task, run.key.configuration), []).append(run)
    combinations, spp = [], _spp(results)
    for (task, name), runs in finished.items():
        size = None if is_own(task, results.settings["task_options"]) else results.settings["size"]
        finals = tuple(run.final if judge is None else judge(run) for run in runs)
        anytime = judge is None and not any(map(_is_noisy, runs))
        combinations.append(Combination(task, name, size, spp, tuple(runs), finals, anytime))
    return combinations


def _is_noisy(run: StoredRun) -> bool:
    """Whether the best loss during the run differs from the noise-free loss."""
    return bool(run.totals["best_loss"] != run.totals["reference_loss"])


class _Judge:
    """Noise-free loss of a run's best candidate at the largest size of the sweep."""

    def __init__(self, results: list[Results]) -> None:
        self._finest = max(results, key=lambda r: (r.settings["size"], _spp(r) or 0))
        self._tasks: dict[str, Task] = {}
        self._targets: dict[str, Float32] = {}

    def __call__(self, run: StoredRun) -> float:
        x = run.totals["x_best"]
        if x is None:
            return float(np.inf)
        task, point = self._task(run.key.task), np.asarray(x, np.float64)
        loss = losses_module.make(run.key.loss, self._target(run.key.task, task))
        reference = TaskInfo.of(task).reference
        image = task.render(point[None], seed=[0])[0] if reference is None else reference(point)
        return float(loss(np.asarray(image)[None])[0])

    def _target(self, name: str, task: Task) -> Float32:
        if name not in self._targets:
            kept = kept_target.read(target_file(self._finest.path, name))
            self._targets[name] = target_of(task) if kept is None else kept.image
        return self._targets[name]

    def _task(self, name: str) -> Task:
        s = self._finest.settings
        if name not in self._tasks:
            made = make_task(name, s["size"], s["task_seed"], s["task_options"])
            self._tasks[name] = made
        return self._tasks[name]


def _spp(results: Results) -> int | None:
    value = results.settings["task_options"].get("spp")
    return None if value is None else int(value)
