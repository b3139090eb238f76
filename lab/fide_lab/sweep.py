"""Results of a sweep: loss of each combination for a cost in seconds or renders; Pareto front.

Losses during a run can be compared if all images have the same size and no noise.  If the sweep
has several sizes or numbers of samples per pixel, or if images are noisy, a run counts only from
its end, with the loss of its best candidate at the largest size and without noise.  A user's
renderer has no image without noise; whether it is noisy is not known, and its losses count as seen.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fide_lab.compare import Configuration, Plan, Results, StoredRun, read as read_comparison
from fide_lab.compare.directory import read_record
from fide_lab.compare.plan import as_file_name, split, target_file
from fide_lab.compare.results import NoResultsError
from fide_lab.report import plots
from fide_lab.run.prepare import make_task, target_of
from fide_lab.run.task import Task, TaskInfo, is_own
from fide_plugins import losses as losses_module
from fide_plugins.errors import OptionError, UnknownNameError
from fide_plugins.options import PRESETS
from fide_plugins.recording.storage import check_settings, read_target
from fide_plugins.runtime import files
from fide_plugins.types import Float32

OPTIMIZER = ("preset", "popsize", "encoder")
NETWORK = ("epochs", "steps")
TASK = ("size", "spp")
OPTIONS = (*OPTIMIZER, *NETWORK, *TASK)
"""Options that can be swept."""
DEFAULTS: Mapping[str, tuple[Any, ...]] = {
    "preset": tuple(PRESETS),
    "epochs": (4,),
    "size": (112,),
}
"""Values of options that are not given; other options have the value of the preset."""


@dataclass(frozen=True)
class Grid:
    """A sweep.

    options: values to sweep by name, of the names in `OPTIONS`.

    Raises OptionError (a ValueError) for an unknown name, no values, a repeated value, network
    options if no preset has a network, or sizes of a user's renderer, which has its own.
    """

    tasks: tuple[str, ...]
    options: Mapping[str, Sequence[Any]]
    loss: str = "mse"
    seeds: int = 3
    budget: int = 2000
    task_seed: int = 0
    task_options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, values in self.options.items():
            if name not in OPTIONS:
                raise UnknownNameError.of("option to sweep", name, OPTIONS)
            if not values or len(set(values)) < len(values):
                raise OptionError(f"{name} needs values, each once, not {list(values)!r}")
        for preset in self.values("preset"):
            if preset not in PRESETS:
                raise UnknownNameError.of("preset", preset, PRESETS)
        of_network = [name for name in NETWORK if name in self.options]
        if of_network and not any(PRESETS[preset].has_network for preset in self.values("preset")):
            raise OptionError(
                f"{of_network[0]} is an option of the network, and no preset has one "
                f"({', '.join(self.values('preset'))}): leave it out, or add paper"
            )

        self._check_sizes()

    def _check_sizes(self) -> None:
        own = [task for task in self.tasks if is_own(task, self.task_options)]
        sizes = self.options.get("size", ())
        if own and sizes and (len(own) == len(self.tasks) or len(sizes) > 1):
            raise OptionError(
                f"size is for built-in tasks; {own[0]} is a renderer of your own and has its own "
                "size: change it there"
            )

    def values(self, option: str) -> tuple[Any, ...]:
        """Values of an option; empty if it has the value of each preset."""
        return tuple(self.options.get(option, DEFAULTS.get(option, ())))

    def configurations(self) -> list[Configuration]:
        """Every combination of optimizer options."""
        configurations: dict[str, Configuration] = {}
        for preset in self.values("preset"):
            possible = (*OPTIMIZER[1:], *NETWORK * PRESETS[preset].has_network)
            names = [name for name in possible if self.values(name)]
            for chosen in product(*(self.values(name) for name in names)):
                pairs = zip(("preset", *names), (preset, *chosen), strict=True)
                text = ":".join(("fide", *(f"{key}={value}" for key, value in pairs)))
                configuration = Configuration.parse(text)
                configurations[configuration.label] = configuration
        return list(configurations.values())

    def check(self, out: Path) -> None:
        """Check that this sweep can extend the one in the folder `out`, if there is one.

        Raises RunDirectoryError (a FileExistsError) if that has another loss, budget or target.
        """
        mine = self._comparable({**self.task_options}, (self.loss,), self.budget, self.task_seed)
        for path in sorted(out.glob("*/study.json")):
            record = read_record(path.parent)
            theirs = record["settings"] if record else {}
            there = self._comparable(
                *(theirs[key] for key in ("task_options", "metrics", "budget", "task_seed"))
            )
            check_settings(there, mine, f"{out} holds a sweep")

    @staticmethod
    def _comparable(
        task_options: Mapping[str, Any], losses: Sequence[str], budget: int, task_seed: int
    ) -> dict[str, Any]:
        options = {key: value for key, value in task_options.items() if key not in TASK}
        return {
            "task options": options, "loss": losses[0], "budget": budget, "task seed": task_seed,
        }  # fmt: skip

    def plans(self) -> Iterator[tuple[str, Plan]]:
        """Every combination of task options: name of its folder, and its plan."""
        for chosen in product(self.values("size"), self.values("spp") or (None,)):
            size, spp = chosen
            options = self.task_options if spp is None else {**self.task_options, "spp": spp}
            name = f"size-{size}" + ("" if spp is None else f"-spp-{spp}")
            yield name, Plan(
                self.tasks, tuple(self.configurations()), (self.loss,), self.seeds, self.budget,
                size, self.task_seed, options, metrics=(self.loss,),
            )  # fmt: skip


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
            kept = read_target(target_file(self._finest.path, name))
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


TIMES = {"1 minute": 60.0, "10 minutes": 600.0, "an hour": 3600.0}
"""Times, in seconds, for which a combination is recommended."""


ONE_SEED = (
    "- one seed decides nothing: some combinations were run once, and another seed may reverse "
    "their order; run at least five (--seeds 5 --resume)"
)


def advice(combinations: Sequence[Combination]) -> dict[str, Point | None]:
    """The best point for each of `TIMES`; combinations: all of one task."""
    return {name: best_within(combinations, "seconds", cost) for name, cost in TIMES.items()}


def write_tables(out: Path, combinations: Sequence[Combination]) -> str:
    """Write tradeoff.md, tradeoff.csv and the figures; returns the text of tradeoff.md."""
    files.write_text(out / "tradeoff.csv", _csv(combinations))
    sections = []
    for task in dict.fromkeys(each.task for each in combinations):
        mine = [each for each in combinations if each.task == task]
        for axis in AXES:
            figure = plots.tradeoff(_curves(mine, axis), _staircase(mine, axis), axis, _loss(mine))
            stem = out / f"tradeoff-{as_file_name(task)}-{axis}"
            files.write_bytes(stem.with_name(stem.name + ".svg"), plots.as_file(figure))
            files.write_bytes(stem.with_name(stem.name + ".png"), plots.png(figure))
        sections.append(_section(task, mine))
    text = "\n\n".join(["# Speed against accuracy", *sections]) + "\n"
    files.write_text(out / "tradeoff.md", text)
    return text


def short_labels(combinations: Sequence[Combination]) -> dict[Combination, str]:
    """Labels without the options that all combinations share; the preset stays."""
    shared = _shared(combinations).split()
    return {
        s: " ".join((s.words[0], *(word for word in s.words[1:] if word not in shared)))
        for s in combinations
    }


def _shared(combinations: Sequence[Combination]) -> str:
    common = set.intersection(*(set(s.words[1:]) for s in combinations))
    return " ".join(word for word in combinations[0].words[1:] if word in common)


def _section(task: str, combinations: Sequence[Combination]) -> str:
    names = [f"tradeoff-{as_file_name(task)}-{axis}.png" for axis in AXES]
    title = f"{_loss(combinations)} of {task}"
    pictures = [f"![{title} against {a}]({n})" for a, n in zip(AXES, names, strict=True)]
    parts = [f"## {task}", "\n".join(_advice_lines(combinations)), _table(combinations), *pictures]
    return "\n\n".join(parts)


def _advice_lines(combinations: Sequence[Combination]) -> list[str]:
    """One line for each of `TIMES`, with a hint if the runs were too long or too short.

    The first line says so where a combination has one run only.
    """
    lines, labels = [], short_labels(combinations)
    if len(combinations) > 1 and min(len(each.runs) for each in combinations) == 1:
        lines.append(ONE_SEED)
    for name, point in advice(combinations).items():
        if point is None:
            lines.append(
                f"- best in {name}: no run had ended by then; give fewer renders (--budget)"
            )
            continue
        line = f"`{labels[point.combination]}` ({point.loss:.4g})"
        end = point.combination.end("seconds")
        if end < TIMES[name]:
            line += f", which ended after {end:.3g} s: give more renders (--budget) to use the time"
        lines.append(f"- best in {name}: {line}")
    return lines


def _table(combinations: Sequence[Combination]) -> str:
    labels = short_labels(combinations)
    on = {axis: {point.combination for point in front(combinations, axis)} for axis in AXES}
    lines = [
        f"| {_shared(combinations)} | runs | renders | seconds | ms per render | "
        f"{_loss(combinations)} | on the front of |",
        "|---|---|---|---|---|---|---|",
    ]
    for s in sorted(combinations, key=lambda s: s.final):
        renders, seconds = s.end("renders"), s.end("seconds")
        fronts = ", ".join(axis for axis in AXES if s in on[axis])
        texts = [labels[s], str(len(s.runs)), f"{renders:.0f}", f"{seconds:.3g}"]
        texts += [f"{1e3 * seconds / renders:.3g}", f"{s.final:.4g}", fronts]
        lines.append(f"| {' | '.join(texts)} |")
    return "\n".join(lines)


def _csv(combinations: Sequence[Combination]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["task", "setting", "size", "spp", "axis", "cost", "loss"])
    for s in combinations:
        for axis in AXES:
            for point in s.points(axis):
                cost, loss = f"{point.cost:.6g}", f"{point.loss:.6g}"
                writer.writerow([s.task, s.name, s.size, s.spp, axis, cost, loss])
    return text.getvalue()


def _curves(combinations: Sequence[Combination], axis: str) -> dict[str, list[tuple[float, float]]]:
    labels = short_labels(combinations)
    return {labels[s]: [(p.cost, p.loss) for p in s.points(axis)] for s in combinations}


def _staircase(combinations: Sequence[Combination], axis: str) -> list[tuple[float, float]]:
    return [(point.cost, point.loss) for point in front(combinations, axis)]


def _loss(combinations: Sequence[Combination]) -> str:
    name: Any = combinations[0].runs[0].key.loss
    return str(name)
