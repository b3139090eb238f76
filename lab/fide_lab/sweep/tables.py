"""Tables and figures of a sweep, and the recommended combinations."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fide_lab.compare.plan import as_file_name
from fide_lab.report import plots
from fide_lab.sweep import AXES, Combination, Point, best_within, front
from fide_plugins.runtime import files

__all__ = ["TIMES", "advice", "short_labels", "write"]

TIMES = {"1 minute": 60.0, "10 minutes": 600.0, "an hour": 3600.0}
"""Times, in seconds, for which a combination is recommended."""


ONE_SEED = (
    "- one seed decides nothing: some combinations were run once, and another seed may reverse "
    "their order; run at least five (--seeds 5 --resume)"
)


def advice(combinations: Sequence[Combination]) -> dict[str, Point | None]:
    """The best point for each of `TIMES`; combinations: all of one task."""
    return {name: best_within(combinations, "seconds", cost) for name, cost in TIMES.items()}


def write(out: Path, combinations: Sequence[Combination]) -> str:
    """Write tradeoff.md, tradeoff.csv and the figures; returns the text of tradeoff.md.

    Raises OSError if a file cannot be written.
    """
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
    """Options that all combinations share, without the preset."""
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
    """Table of all combinations, the lowest loss first."""
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
    """One line for each combination, axis and mark."""
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
