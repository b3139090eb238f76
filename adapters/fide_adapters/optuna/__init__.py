"""FIDE as a sampler for Optuna.

Any number of processes may work on one study.  Each makes its own sampler with the same settings;
they share nothing but Optuna's storage.  `docs/reference/optuna.md` explains how they agree.
"""

from __future__ import annotations

from fide_plugins.runtime.machine import missing

try:
    import optuna  # noqa: F401  # fails here, with a remedy, where Optuna is not installed
except ImportError as error:
    raise missing("optuna", "fide_adapters.optuna needs Optuna") from error

from fide_adapters.image_loss import ImageLoss
from fide_adapters.optuna.sampler import FIDESampler, image_objective

__all__ = ["FIDESampler", "ImageLoss", "image_objective"]
