from __future__ import annotations

from typing import Any

from fide_lab import suite as suites
from fide_lab.run.prepare import make_task
from fide_plugins import losses
import numpy as np
import optuna
from optunahub.benchmarks import BaseProblem


class Problem(BaseProblem):
    """One picture of one scene: its loss, in the parameters x0, x1, ... in [0, 1].

    Args:
        scene: One of :attr:`scenes`, such as ``"voronoi"``.
        number: Number of the target, from 0; each scene of a suite has at least ten.
        suite: ``"image-fitting-v1"``, or ``"image-fitting-v2"`` and ``"image-fitting-v3"``, the
            same scenes with other targets.

    Raises a ValueError for names and numbers that the suite has not.
    """

    def __init__(
        self, scene: str = "voronoi", number: int = 0, suite: str = "image-fitting-v1"
    ) -> None:
        fixed = suites.read(suite)
        self.name = fixed.problem_of(scene, number)
        entry, _ = fixed.problem(self.name)
        self._task = make_task(self.name, 0, 0, {"suite": suite})
        self.scenes = tuple(fixed.scenes)
        self.budgets = fixed.budgets
        self.solved = entry.solved
        self.target = np.asarray(self._task.target)
        self._loss = losses.make(entry.loss, self.target)

    @property
    def search_space(self) -> dict[str, optuna.distributions.BaseDistribution]:
        unit = optuna.distributions.FloatDistribution(0, 1)
        return {f"x{i}": unit for i in range(self._task.dim)}

    @property
    def directions(self) -> list[optuna.study.StudyDirection]:
        return [optuna.study.StudyDirection.MINIMIZE]

    def render(self, params: dict[str, Any]) -> np.ndarray:
        """The image (H, W, 3) of these parameters, for samplers that look at images."""
        x = np.array([[params[name] for name in self.search_space]])
        image: np.ndarray = np.asarray(self._task.render(x))[0]
        return image

    def evaluate(self, params: dict[str, Any]) -> float:
        return float(self._loss(self.render(params)[None])[0])
