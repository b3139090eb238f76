"""Results as CSV: the totals of every run, and its curve at a few marks."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np

from fide_lab.compare.results import AXES, Results
from fide_plugins.recording.record import PARTS

__all__ = ["curves_csv", "results_csv"]

_MARKS_A_DECADE = 12


def results_csv(results: Results) -> str:
    """One line for each run: its losses and its cost, empty if the run is not finished.

    Text that a spreadsheet would read as a formula starts with an apostrophe.
    """
    metrics = results.settings["metrics"]
    names = [
        "task", "loss", "optimizer", "seed", "state", "dim", "renders", "best_loss",
        "best_evaluation", "final_loss", "recommended_loss", *(f"final_{m}" for m in metrics),
        "wall_s", *(f"{part}_s" for part in PARTS), "rounds_of_8", "load",
    ]  # fmt: skip
    rows: list[list[Any]] = []
    for result in results.runs:
        cell = result.key
        row = [
            _text(cell.task),
            _text(cell.loss),
            _text(cell.configuration),
            cell.seed,
            result.state,
        ]
        if result.curve is not None:
            t = result.totals
            row += [
                t["dim"], t["evaluations"], t["best_loss"], t["best_evaluation"],
                t["reference_loss"], t["recommended_loss"],
                *(t["judged"].get(m) for m in metrics), _round(t["wall_s"]),
                *(_round(t["times"][part]) for part in PARTS), t["rounds"], result.run.get("load"),
            ]  # fmt: skip
        rows.append(row + [None] * (len(names) - len(row)))
    return _csv(names, rows)


def curves_csv(results: Results) -> str:
    """The best loss so far of every finished run, at geometrically spaced numbers of renders.

    Rounds are those of eight parallel renders.  Seconds and rounds belong to the evaluation that
    reached the loss.
    """
    names = ["task", "loss", "optimizer", "seed", *AXES, "best_loss", *results.settings["metrics"]]
    rows: list[list[Any]] = []
    for result in results.runs:
        curve, cell = result.curve, result.key
        if curve is None or not len(curve.loss):
            continue
        end = curve.ends["renders"]
        count = 2 + int(_MARKS_A_DECADE * np.log10(max(end, 1)))
        marks = np.unique(np.rint(np.geomspace(1, end, count)))
        index = np.searchsorted(curve.at["renders"], marks, side="right") - 1
        for mark, i in zip(marks.tolist(), index.tolist(), strict=True):
            if i < 0:
                continue
            where = [int(mark), _round(curve.at["seconds"][i]), int(curve.at["rounds"][i])]
            values = [f"{curve.loss[i]:.6g}", *(f"{v[i]:.6g}" for v in curve.metrics.values())]
            rows.append(
                [
                    _text(cell.task),
                    _text(cell.loss),
                    _text(cell.configuration),
                    cell.seed,
                    *where,
                    *values,
                ]
            )
    return _csv(names, rows)


def _csv(names: list[str], rows: list[list[Any]]) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(names)
    writer.writerows(rows)
    return buffer.getvalue()


def _text(text: str) -> str:
    return f"'{text}" if text[:1] in "=+-@\t\r" else text


def _round(seconds: float) -> float:
    return round(float(seconds), 4)
