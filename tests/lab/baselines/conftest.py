"""All baselines, each small enough for a test, and a picture that all of them can look at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from fide_lab import optimizers
from fide_lab.baselines.base import Baseline
from fide_plugins.types import Float32, Float64

from .small import OPTIONS


@dataclass(frozen=True)
class Subject:
    """A baseline with the options of `small.py`, which make it quick.

    evaluations: enough to see all that it does, such as restarts or a training.
    close: loss of `sphere` that it reaches with many workers, within 100 evaluations (cma: 400).
    """

    name: str
    evaluations: int = 80
    close: float = 0.16

    def __str__(self) -> str:
        return self.name

    def make(self, dim: int, seed: int | None = None, **options: Any) -> Baseline:
        """One, with a target."""
        settings = {**OPTIONS.get(self.name, {}), "seed": seed, **options}
        made = optimizers.make(self.name, dim, target(), **settings)
        assert isinstance(made, Baseline)
        return made

    def load(self, path: Any) -> Baseline:
        """One that was saved."""
        loaded = optimizers.load(self.name, path)
        assert isinstance(loaded, Baseline)
        return loaded

    def tell(self, opt: Baseline, X: Float64, losses: Float64 | None = None) -> None:
        """Tell the images of points, and their losses by `sphere` or those given."""
        opt.tell(X, self.render(X), sphere(X) if losses is None else losses)

    def minimize(self, opt: Baseline, evaluations: int) -> list[Float64]:
        """Ask and tell until there are so many; returns what was asked."""
        asked = []
        while opt.evaluations < evaluations:
            X = opt.ask()
            self.tell(opt, X)
            asked.append(X)
        return asked

    def render(self, X: Float64) -> Float32:
        """Images of points."""
        return render(X)

    @property
    def sequential(self) -> bool:
        """Whether it evaluates one point after the other."""
        return self.name in ("dual-annealing", "fide-annealing", "dfols")

    @property
    def threads(self) -> int:
        """Threads of its own while it waits for results."""
        return int(self.sequential)

    @property
    def looks(self) -> bool:
        """Whether it needs images."""
        return self.name in ("eki", "dfols", "fide-annealing", "inverse", "sge")


SUBJECTS = [
    Subject("cma", evaluations=400, close=1e-4),
    Subject("dfols", evaluations=40),
    Subject("dibo", evaluations=60),
    Subject("diffusion-evolution"),
    Subject("dual-annealing"),
    Subject("eki", close=0.1),
    Subject("fide-annealing", evaluations=60),
    Subject("inverse"),
    Subject("nevergrad:TwoPointsDE", evaluations=40),
    Subject("optuna:CmaEsSampler", evaluations=40),
    Subject("random"),
    Subject("sge"),
    Subject("zerograds"),
]


def sphere(X: Float64) -> Float64:
    """Loss with its minimum at 0.3 in every parameter."""
    value: Float64 = ((X - 0.3) ** 2).sum(axis=1)
    return value


def render(X: Float64) -> Float32:
    """Images (n, 16, 16, 3) of points: every parameter brightens a pattern of its own."""
    rng = np.random.default_rng(5)
    patterns = rng.random((X.shape[1], 16, 16, 3)) / X.shape[1]
    images: Float32 = np.tensordot(X, patterns, axes=1).astype(np.float32)
    return images


def target(dim: int = 3) -> Float32:
    """What is rendered where `sphere` is least."""
    image: Float32 = render(np.full((1, dim), 0.3))[0]
    return image


@pytest.fixture(params=SUBJECTS, ids=str)
def subject(request: pytest.FixtureRequest) -> Subject:
    """Every baseline, one after the other."""
    chosen: Subject = request.param
    return chosen


@pytest.fixture
def subjects() -> list[Subject]:
    """All of them."""
    return SUBJECTS
