"""Watch a fit: a callback of your own, MLflow, Weights & Biases; all of them offline.

Those that are not installed are skipped.
"""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fide_plugins import Float, Space, fit
from fide_plugins.errors import DependencyError
from fide_plugins.fitting.callbacks import Event
from fide_plugins.fitting.result import Result

BUDGET, SEED = 300, 0
yy, xx = np.mgrid[0:48, 0:48] / 47
space = Space(x=Float(0, 1), y=Float(0, 1), radius=Float(0.1, 0.4))


def render(p: dict[str, float]) -> NDArray[np.float64]:
    edge = np.hypot(xx - p["x"], yy - p["y"]) - p["radius"]
    image: NDArray[np.float64] = 1 / (1 + np.exp(30 * edge))
    return image


def say(event: Event) -> bool:
    """A function is called after each evaluation; True stops the fit."""
    if event.loss == event.best_loss:
        print(f"{event.evaluation + 1}: loss {event.loss:.2e}")
    return event.loss < 1e-4


class MLflow:
    """Metrics, parameters and images as a run of MLflow, in a local folder."""

    def __init__(self, folder: Path) -> None:
        self.mlflow: Any = import_module("mlflow")
        self.mlflow.set_tracking_uri(f"sqlite:///{folder / 'mlflow.db'}")
        self.mlflow.start_run(run_name="disk")
        self.mlflow.log_params({"budget": BUDGET, "seed": SEED})

    def on_evaluation(self, event: Event) -> None:
        metrics = {"loss": event.loss, "best_loss": event.best_loss}
        self.mlflow.log_metrics(metrics, step=event.evaluation + 1)
        if event.loss == event.best_loss:
            self.mlflow.log_metrics(event.params or {}, step=event.evaluation + 1)

    def on_end(self, result: Result) -> None:
        self.mlflow.log_dict(result.params, "params.json")
        self.mlflow.end_run()


class WeightsAndBiases:
    """The same as a run of Weights & Biases, kept here (`wandb sync` uploads it)."""

    def __init__(self, folder: Path) -> None:
        os.environ.setdefault("WANDB_SILENT", "true")
        self.wandb: Any = import_module("wandb")
        config = {"budget": BUDGET, "seed": SEED}
        self.run = self.wandb.init(project="disk", mode="offline", dir=folder, config=config)

    def on_evaluation(self, event: Event) -> None:
        self.run.log({"loss": event.loss, "best_loss": event.best_loss}, commit=False)
        if event.loss == event.best_loss:
            self.run.log({"best": self.wandb.Image(event.image)}, commit=False)
        self.run.log({})

    def on_end(self, result: Result) -> None:
        self.run.summary.update(result.params)
        self.run.finish()


def main() -> None:
    folder = Path("runs/callbacks")
    folder.mkdir(parents=True, exist_ok=True)
    callbacks: list[Any] = [say]
    for make in (MLflow, WeightsAndBiases):
        try:
            callbacks.append(make(folder))
        except (ImportError, DependencyError) as error:
            print(f"without {make.__name__}: {error}")
    target = render({"x": 0.7, "y": 0.35, "radius": 0.25})
    print(fit(render, target, space, budget=BUDGET, workers=0, seed=SEED, callbacks=callbacks))
    print(f"look into {folder}")


if __name__ == "__main__":
    main()
