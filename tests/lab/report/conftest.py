"""Comparisons that were made up: curves with known numbers, names that try to be markup."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import compare, optimizers, report
from fide_lab.baselines.evolution import Random
from fide_lab.compare import Configuration, Plan, Results, RunKey, StoredRun
from fide_lab.compare.results import Curve
from fide_plugins import losses
from fide_plugins.losses.base import MeanSquaredError

NASTY = {
    "task": "<b>&task $x$ \\1",
    "configuration": "<script>alert(1)</script>",
    "loss": "\"><img src=x onerror=alert(2)>'",
}


def curve(renders: Sequence[int], values: Sequence[float], end: int) -> Curve:
    """A curve of which every render took a tenth of a second."""
    at = np.array(renders, float)
    return Curve(
        {"renders": at, "seconds": at / 10},
        {"renders": float(end), "seconds": end / 10},
        np.array(values, float),
        {},
    )


def result(
    label: str,
    seed: int,
    final: float | None,
    *,
    task: str = "t",
    loss: str = "mse",
    end: int = 100,
) -> StoredRun:
    """A finished run that went from 1 to `final` at its 10th render."""
    totals = {
        "reference_loss": final, "best_loss": final, "evaluations": end, "dim": 3, "judged": {},
        "wall_s": end / 10, "best_evaluation": 9, "recommended_loss": None,
        "times": {"render": 1.0, "encode": 2.0, "train": 3.0, "search": 3.5},
    }  # fmt: skip
    known = [] if final is None else [final]
    found = curve([1, 10][: 1 + len(known)], [1.0, *known], end)
    return StoredRun(RunKey(task, loss, label, seed), Path("nowhere"), "finished", "",
                      {"totals": totals, "settings": {"size": [24, 24]}}, found)  # fmt: skip


def failed(label: str, seed: int, *, task: str = "t") -> StoredRun:
    """A run that failed."""
    return StoredRun(RunKey(task, "mse", label, seed), Path("nowhere"), "failed", "ValueError")


def missing(label: str, seed: int) -> StoredRun:
    """A run that has not begun."""
    return StoredRun(RunKey("t", "mse", label, seed), Path("nowhere"), "missing")


def results(runs: Sequence[StoredRun]) -> Results:
    return Results(Path("nowhere"), {"metrics": []}, [], {}, {}, list(runs))


@pytest.fixture(scope="session")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real comparison whose task, optimizer and loss have names that try to be markup."""
    from fide_tasks import registry

    class Nasty(Random):
        name = NASTY["configuration"]

        def tell(self, X: object, images: object = None, losses: object = None) -> None:
            if self.seed == 2:
                raise ArithmeticError("<i>no</i> & 'never'")
            super().tell(X, images, losses)

    class Loss(MeanSquaredError):
        name = NASTY["loss"]

    tasks: Any = registry._TASKS
    tasks[NASTY["task"]] = tasks["voronoi"]
    optimizers.register(NASTY["configuration"], Nasty)
    losses.register(NASTY["loss"], Loss)
    out = tmp_path_factory.mktemp("study") / "out"
    configurations = tuple(map(Configuration.parse, ("cma", NASTY["configuration"])))
    plan = Plan(
        (NASTY["task"],), configurations, (NASTY["loss"],), seeds=3, budget=40, size=24,
        task_options={"cells": 2}, metrics=(NASTY["loss"], "mse"),
    )  # fmt: skip
    try:
        compare.run(plan, out, command=["fide", "compare", NASTY["task"]])
    finally:  # at once, for others list what is known
        tasks.pop(NASTY["task"])
        optimizers._REGISTRY._factories.pop(NASTY["configuration"])
        losses._REGISTRY._factories.pop(NASTY["loss"])
    return out


@pytest.fixture(scope="session")
def written(study: Path) -> Path:
    """Its report, the page."""
    return report.write(compare.read(study), study / "report.html").page
