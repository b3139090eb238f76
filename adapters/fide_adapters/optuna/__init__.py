"""FIDE as a sampler for Optuna.

    import optuna
    from fide_adapters.optuna import FIDESampler

    sampler = FIDESampler(target=picture, seed=0)
    study = optuna.create_study(sampler=sampler)

    def objective(trial):
        image = render(trial.suggest_float("x", 0, 1), trial.suggest_float("y", 0, 1))
        return sampler.tell_image(trial, image)

    study.optimize(objective, n_trials=1000)

Any number of processes may work on one study.  Each makes its own sampler with the same settings;
they share nothing but Optuna's storage.  `docs/reference/optuna.md` explains how they agree.
"""

from __future__ import annotations

from fide_plugins.runtime.machine import missing

try:
    import optuna  # noqa: F401  # fails here, with a remedy, where Optuna is not installed
except ImportError as error:
    raise missing("optuna", "fide_adapters.optuna needs Optuna") from error

from fide_adapters.image_loss import ImageLoss, ImageRef
from fide_adapters.optuna.sampler import FIDESampler, image_objective

__all__ = ["FIDESampler", "ImageLoss", "ImageRef", "image_objective"]
