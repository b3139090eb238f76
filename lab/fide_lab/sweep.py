"""A comparison over combinations of FIDE's options: loss for a cost, and their Pareto front.

Losses during a run can be compared where images have no noise.  Otherwise a run counts only from
its end, with the loss of its best candidate without noise.  A user's renderer has no image without
noise; whether it is noisy is not known, and its losses count as seen.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fide_lab.compare import Configuration, Results, StoredRun
from fide_lab.compare.plan import as_file_name, split
from fide_lab.compare.results import AXES, NoResultsError
from fide_lab.report import plots
from fide_lab.report.tables import Table, markdown
from fide_plugins.errors import OptionError, UnknownNameError
from fide_plugins.options import PRESETS
from fide_plugins.runtime import files

TIMES = {"1 minute": 60.0, "10 minutes": 600.0, "an hour": 3600.0}
"""Times, in seconds, for which a combination is recommended."""
_MARKS = 60  # geometrically spaced costs at which a run is evaluated


def configurations(options: Mapping[str, Sequence[Any]]) -> tuple[Configuration, ...]:
    """FIDE with every combination of these values; all presets if none is named.

    Raises OptionError (a ValueError) for no values, a repeated value, or an unknown preset.
    """
    options = {"preset": tuple(PRESETS), **options}
    for name, values in options.items():
        if not values or len(set(values)) < len(values):
            raise OptionError(f"{name} needs values, each once, not {list(values)!r}")
    for preset in options["preset"]:
        if preset not in PRESETS:
            raise UnknownNameError.of("preset", preset, PRESETS)
    texts = (
        ":".join(
            ["fide", *(f"{name}={value}" for name, value in zip(options, chosen, strict=True))]
        )
        for chosen in product(*options.values())
    )
    return tuple(map(Configuration.parse, texts))


class Point(NamedTuple):
    """Loss of a combination at a cost in seconds or renders."""

    cost: float
    loss: float
    combination: Combination


@dataclass(frozen=True, eq=False)
class Combination:
    """One combination of options on one task; name: label of its configuration; runs: finished."""

    task: str
    name: str
    runs: tuple[StoredRun, ...]

    @property
    def anytime(self) -> bool:
        """Whether losses during the runs are comparable: not those of noisy images."""
        return all(run.totals["best_loss"] == run.totals["reference_loss"] for run in self.runs)

    @property
    def label(self) -> str:
        """The preset, and the other options."""
        options = dict(word.split("=", 1) for word in split(self.name)[1])
        return " ".join([options.pop("preset"), *(f"{k}={v}" for k, v in options.items())])

    def end(self, axis: str) -> float:
        """Median cost of a complete run."""
        return float(np.median([run.curve.ends[axis] for run in self.runs if run.curve]))

    @property
    def final(self) -> float:
        """Median final loss of the runs."""
        return float(np.median([run.final for run in self.runs]))

    def loss_at(self, axis: str, cost: float) -> float:
        """Median loss for a cost; infinity if there is no loss yet."""
        losses = []
        for run in self.runs:
            assert run.curve is not None  # all runs are finished
            under_way = run.curve.loss_at(axis, cost) if self.anytime else np.inf
            losses.append(run.final if cost >= run.curve.ends[axis] else under_way)
        return float(np.median(losses))

    def points(self, axis: str) -> list[Point]:
        """Points along the runs if `anytime`, otherwise one at their end; those of finite loss."""
        curves = [run.curve for run in self.runs if run.curve]
        starts = [curve.at[axis][0] for curve in curves if len(curve.loss)]
        marks = [self.end(axis)]
        if self.anytime and starts:
            longest = max(curve.ends[axis] for curve in curves)
            marks = np.geomspace(max(min(starts), 1e-6), longest, _MARKS).tolist()
        found = [Point(cost, self.loss_at(axis, cost), self) for cost in marks]
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


def combinations_of(results: Results) -> list[Combination]:
    """All combinations that have a finished run.

    Raises NoResultsError (a FileNotFoundError) if there is none.
    """
    finished: dict[tuple[str, str], list[StoredRun]] = {}
    for run in results.runs:
        if run.curve is not None:
            finished.setdefault((run.key.task, run.key.configuration), []).append(run)
    if not finished:
        raise NoResultsError(
            f"{results.path} holds no finished run of a sweep; run: fide tradeoff --resume"
        )
    return [Combination(*key, tuple(runs)) for key, runs in finished.items()]


def advice(combinations: Sequence[Combination]) -> dict[str, Point | None]:
    """The best point for each of `TIMES`; combinations: all of one task."""
    return {name: best_within(combinations, "seconds", cost) for name, cost in TIMES.items()}


def write_tables(out: Path, combinations: Sequence[Combination]) -> str:
    """Write tradeoff.md and the figures; returns the text of tradeoff.md."""
    parts = ["# Speed against accuracy"]
    for task in dict.fromkeys(each.task for each in combinations):
        mine = [each for each in combinations if each.task == task]
        loss = str(mine[0].runs[0].key.loss)
        parts += [f"## {task}", _advice(mine), markdown(_table(mine, loss))]
        for axis in AXES:
            curves = {s.label: [(p.cost, p.loss) for p in s.points(axis)] for s in mine}
            best = [(point.cost, point.loss) for point in front(mine, axis)]
            name = f"tradeoff-{as_file_name(task)}-{axis}.png"
            files.write_bytes(out / name, plots.png(plots.tradeoff(curves, best, axis, loss)))
            parts.append(f"![{loss} of {task} against {axis}]({name})")
    text = "\n\n".join(parts) + "\n"
    files.write_text(out / "tradeoff.md", text)
    return text


def _advice(combinations: Sequence[Combination]) -> str:
    """One line for each of `TIMES`, with a hint if the runs were too long or too short."""
    lines = []
    if len(combinations) > 1 and min(len(each.runs) for each in combinations) == 1:
        lines.append("- one seed decides nothing; run at least five (--seeds 5 --resume)")
    for name, point in advice(combinations).items():
        if point is None:
            lines.append(f"- best in {name}: no run had ended by then; give a smaller --budget")
            continue
        line = f"- best in {name}: `{point.combination.label}` ({point.loss:.4g})"
        end = point.combination.end("seconds")
        if end < TIMES[name]:
            line += f", which ended after {end:.3g} s: give a larger --budget to use the time"
        lines.append(line)
    return "\n".join(lines)


def _table(combinations: Sequence[Combination], loss: str) -> Table:
    on = {axis: {point.combination for point in front(combinations, axis)} for axis in AXES}
    columns = [
        "combination",
        "runs",
        "renders",
        "seconds",
        "ms per render",
        loss,
        "on the front of",
    ]
    rows = []
    for s in sorted(combinations, key=lambda s: s.final):
        renders, seconds = s.end("renders"), s.end("seconds")
        numbers = f"{renders:.0f}", f"{seconds:.3g}", f"{1e3 * seconds / renders:.3g}"
        fronts = ", ".join(axis for axis in AXES if s in on[axis])
        rows.append([s.label, str(len(s.runs)), *numbers, f"{s.final:.4g}", fronts])
    return Table("", [(name, "") for name in columns], rows)
