"""The settings of a sampler, and the optimizers that are made with them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from optuna.distributions import CategoricalDistribution, distribution_to_json

from fide_adapters.optuna.images import ImageEvaluator
from fide_adapters.optuna.search_space import Distributions
from fide_adapters.optuna.storage import WarnOnce
from fide_plugins.errors import OptionError
from fide_plugins.evaluation import Evaluator
from fide_plugins.fide import FIDE
from fide_plugins.options import make_options, without_images
from fide_plugins.space import Space
from fide_plugins.types import Float64
from fide_plugins.validation.points import new_seed, standard_deviations
from fide_plugins.views import Views

_NO_TARGET = np.zeros((16, 16, 3), np.float32)


class Settings:
    """The settings of a sampler; target None: nothing is proposed; seed None: that of the study."""

    def __init__(
        self,
        target: Views | None,
        loss: str | Callable[..., object] | None,
        preset: str,
        sigma0: float,
        device: str,
        options: Mapping[str, Any],
        seed: int | None,
    ) -> None:
        self._made = make_options(preset, options)
        standard_deviations(sigma0, 1)
        if target is None and loss is not None:
            raise OptionError("a loss of images needs a target: set target=")
        self._target, self._loss, self._options = target, loss, options
        self._preset, self._sigma0, self._device = preset, sigma0, device
        self.seed = None if seed is None else new_seed(seed)
        self.warn = WarnOnce()
        self.images = None if target is None else ImageEvaluator(self._make_evaluator)
        """None without a target."""

    @property
    def problem(self) -> str | None:
        """Digest of target and loss; None without a target."""
        return None if self.images is None else self.images.problem

    def digest_of(self, space: Distributions) -> str:
        """Eight characters; optimizers with equal ones and seeds ask the same."""
        described = {name: _described(space[name]) for name in space}
        settings = [asdict(self._made), self._sigma0, self.problem, described]
        text = json.dumps(settings, sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=4).hexdigest()

    def _make_evaluator(self) -> Evaluator:
        encoder, device, made = self._made.encoder, self._device, self._made
        return Evaluator(self._target, self._loss, encoder, device=device, options=made)

    def make(self, space: Space, seed: int, guess: Float64 | None = None, **changed: Any) -> FIDE:
        """Optimizer in a space; all share one encoder and one loss.

        guess: (dim,), its first candidate, around which it begins.
        """
        # memory is for the next target, which there never is
        options, loss = {"memory_mb": 0.0, **self._options, **changed}, self._loss
        if self.images is None:
            options = without_images(options)
        else:
            options["encoder"], loss = self.images.evaluator.encoder, self.images.evaluator.loss
        return FIDE(
            space, _NO_TARGET if self._target is None else self._target, loss=loss, seed=seed,
            x0=guess, sigma0=self._sigma0, preset=self._preset, device=self._device, **options,
        )  # fmt: skip


def _described(distribution: Any) -> str:
    try:
        return distribution_to_json(distribution)
    except TypeError:  # a study in memory may have choices that are no JSON
        choices = distribution.choices if isinstance(distribution, CategoricalDistribution) else ()
        return json.dumps([getattr(one, "__qualname__", None) or repr(one) for one in choices])
