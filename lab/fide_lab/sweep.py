"""A comparison over combinations of FIDE's options: loss for a cost, and their Pareto front.

Losses during a run can be compared where images have no noise.  Otherwise a run counts only from
its end, with the loss of its best candidate without noise.
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
    pairs = ([f"{name}={value}" for value in values] for name, values in options.items())
    return tuple(Configuration.parse(":".join(("fide", *one))) for one in product(*pairs))


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

    def points(self, axis: str) -> list[Point]:
        """Points of finite median loss along the runs; of noisy images one at their end."""
        curves = [(run.final, run.curve) for run in self.runs if run.curve]
        starts = [curve.at[axis][0] for _, curve in curves if len(curve.loss)]
        anytime = all(r.totals["best_loss"] == r.totals["reference_loss"] for r in self.runs)
        marks = [self.end(axis)]
        if anytime and starts:
            longest = max(curve.ends[axis] for _, curve in curves)
            marks = np.geomspace(max(min(starts), 1e-6), longest, _MARKS).tolist()
        found = []
        for cost in marks:
            losses = [
                final if cost >= c.ends[axis] else c.loss_at(axis, cost) if anytime else np.inf
                for final, c in curves
            ]
            found.append(Point(cost, float(np.median(losses)), self))
        return [point for point in found if np.isfinite(point.loss)]


def front(combinations: Iterable[Combination], axis: str) -> list[Point]:
    """Pareto front: points that no other beats in both cost and loss, by increasing cost."""
    points = [point for each in combinations for point in each.points(axis)]
    kept: list[Point] = []
    for point in sorted(points, key=lambda p: (p.cost, p.loss)):
        if not kept or point.loss < kept[-1].loss:
            kept.append(point)
    return kept


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


def write_tables(out: Path, combinations: Sequence[Combination]) -> str:
    """Write tradeoff.md and the figures; returns the text of tradeoff.md."""
    parts = ["# Speed against accuracy"]
    for task in dict.fromkeys(each.task for each in combinations):
        mine = [each for each in combinations if each.task == task]
        loss = str(mine[0].runs[0].key.loss)
        parts += [f"## {task}", markdown(_table(mine, loss))]
        for axis in AXES:
            curves = {s.label: [(p.cost, p.loss) for p in s.points(axis)] for s in mine}
            best = [(point.cost, point.loss) for point in front(mine, axis)]
            name = f"tradeoff-{as_file_name(task)}-{axis}.png"
            files.write_bytes(out / name, plots.png(plots.tradeoff(curves, best, axis, loss)))
            parts.append(f"![{loss} of {task} against {axis}]({name})")
    text = "\n\n".join(parts) + "\n"
    files.write_text(out / "tradeoff.md", text)
    return text


def _table(combinations: Sequence[Combination], loss: str) -> Table:
    on = {axis: {point.combination for point in front(combinations, axis)} for axis in AXES}
    titles = "combination", "runs", "renders", "seconds", "ms per render", loss, "on the front of"
    rows = []
    for s in sorted(combinations, key=lambda s: s.final):
        renders, seconds = s.end("renders"), s.end("seconds")
        numbers = f"{renders:.0f}", f"{seconds:.3g}", f"{1e3 * seconds / renders:.3g}"
        fronts = ", ".join(axis for axis in AXES if s in on[axis])
        rows.append([s.label, str(len(s.runs)), *numbers, f"{s.final:.4g}", fronts])
    return Table("", [(title, "") for title in titles], rows)
