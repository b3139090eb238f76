"""A small smooth renderer, and objectives that travel to other processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import cloudpickle
import nevergrad as ng
import numpy as np
import pytest

from fide_adapters.nevergrad import ImageLoss, ParametrizedFIDE
from fide_plugins.types import Float32, Float64

SIZE = 16
ANSWER = np.array([0.7, 0.35, 0.6, 0.9, 0.4, 0.2])
GRID = (np.arange(SIZE) + 0.5) / SIZE


@pytest.fixture(autouse=True)
def seeded() -> Iterator[None]:
    """Parametrizations draw their seeds from NumPy's global state."""
    state = np.random.get_state()
    np.random.seed(12)
    yield
    np.random.set_state(state)


def render(x: Float64) -> Float32:
    """Disk (SIZE, SIZE, 3) at x, y = x[:2], of radius and color by the others (6,)."""
    distance = np.hypot(GRID[None, :] - x[0], GRID[:, None] - x[1])
    inside = 1 / (1 + np.exp((distance - 0.1 - 0.3 * x[2]) * 15))
    image: Float32 = (inside[..., None] * x[3:6]).astype(np.float32)
    return image


TARGET = render(ANSWER)


def mse(image: Float32) -> float:
    """As the loss `mse` has it."""
    return float(((image.astype(np.float64) - TARGET) ** 2).mean())


def box(dim: int = 6) -> Any:
    """The cube of FIDE as Nevergrad has it."""
    return ng.p.Array(shape=(dim,), lower=0, upper=1)


def fide(
    parametrization: Any = None, budget: int | None = 100, workers: int = 1, **options: Any
) -> Any:
    """FIDE for the disk, the same each time."""
    options = {"target": TARGET, "seed": 0, **options}
    parametrization = box() if parametrization is None else parametrization
    return ParametrizedFIDE(**options)(parametrization, budget=budget, num_workers=workers)


def told(optimizer: Any, n: int) -> list[Float64]:
    """Ask and tell n candidates with their images; returns their values."""
    values = []
    for _ in range(n):
        candidate = optimizer.ask()
        optimizer.tell(candidate, render(candidate.value))
        values.append(candidate.value)
    return values


class Portable:
    """A function of any kind that reaches other processes by its code and not by its name."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.function(*args, **kwargs)

    def __reduce__(self) -> Any:
        return cloudpickle.loads, (cloudpickle.dumps(self.function),)


def traveling() -> Portable:
    """Objective of the disk, for workers that know nothing of these tests."""
    grid, target = GRID, TARGET

    def objective(x: Any) -> Any:
        import numpy as np

        from fide_adapters.image_loss import ImageLoss

        distance = np.hypot(grid[None, :] - x[0], grid[:, None] - x[1])
        inside = 1 / (1 + np.exp((distance - 0.1 - 0.3 * x[2]) * 15))
        image = (inside[..., None] * x[3:6]).astype(np.float32)
        return ImageLoss(float(((image.astype(np.float64) - target) ** 2).mean()), image)

    return Portable(objective)


def objective(x: Float64) -> ImageLoss:
    """The same, here."""
    image = render(x)
    return ImageLoss(mse(image), image)
