"""An optimizer of your own, in 15 lines, raced against the others from the command line.

python examples/own_optimizer.py
fide compare voronoi --optimizers fide,examples/own_optimizer.py:Elitist --seeds 3 --out runs/own
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fide_lab import run as harness


class Elitist:
    """Normal steps around the best point; shorter when none of them is better."""

    def __init__(self, dim: int, seed: int | None = None, step: float = 0.2) -> None:
        self.rng = np.random.default_rng(seed)
        self.x, self.loss, self.step = np.full(dim, 0.5), np.inf, step

    def ask(self, n: int) -> NDArray[np.float64]:
        steps = self.step * self.rng.standard_normal((n, len(self.x)))
        return np.clip(self.x + steps, 0, 1)

    def tell(self, X: NDArray[np.float64], losses: NDArray[np.float64]) -> None:
        best = losses.argmin()
        better = losses[best] < self.loss
        self.step *= 1.3 if better else 0.8
        if better:
            self.x, self.loss = X[best], losses[best]


def main() -> None:
    reference = f"{Path(__file__).resolve()}:Elitist"
    result = harness.run("voronoi", reference, budget=2000, size=64)
    print(f"loss {result.losses[0]:.4f}, after 2,000 renders {result.best_loss:.4f}")


if __name__ == "__main__":
    main()
