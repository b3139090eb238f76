"""FIDE as a Nevergrad optimizer: eight Voronoi cells, compared with Nevergrad's CMA-ES.

The objective returns the image with the loss.  FIDE uses both, every other optimizer only the loss;
nothing else differs.  Writes nevergrad_voronoi.png (target, FIDE, CMA-ES).
"""

from __future__ import annotations

import nevergrad as ng
import numpy as np
from numpy.typing import NDArray
from PIL import Image

import fide_tasks
from fide_adapters.nevergrad import ImageLoss, ParametrizedFIDE

BUDGET = 1000


def main() -> None:
    task = fide_tasks.make("voronoi", size=64, seed=0)

    def render(x: NDArray[np.float64]) -> NDArray[np.float32]:
        image: NDArray[np.float32] = task.render(x[None])[0]
        return image

    def objective(x: NDArray[np.float64]) -> ImageLoss:
        image = render(x)
        return ImageLoss(float(((image - task.target) ** 2).mean()), image)

    pictures = [task.target]
    for name, kind in (
        ("FIDE", ParametrizedFIDE(target=task.target)),
        ("CMA-ES", ng.optimizers.registry["CMA"]),
    ):
        parametrization = ng.p.Array(shape=(task.dim,), lower=0, upper=1)
        parametrization.random_state.seed(0)
        best = kind(parametrization, budget=BUDGET).minimize(objective)
        print(f"{name:6}  MSE {objective(best.value):.5f} after {BUDGET} renders")
        pictures.append(render(best.value))
    strip = np.rint(np.concatenate(pictures, axis=1) * 255).astype(np.uint8)
    Image.fromarray(strip).save("nevergrad_voronoi.png")


if __name__ == "__main__":
    main()
