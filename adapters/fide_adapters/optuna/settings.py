"""The settings of a sampler, and the optimizers that are made with them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution, CategoricalDistribution, distribution_to_json
from optuna.samplers import BaseSampler

from fide_adapters.optuna.images import ImageArtifacts, ImageEvaluator
from fide_adapters.optuna.storage import WarnOnce
from fide_plugins.errors import OptionError
from fide_plugins.evaluation import Evaluator
from fide_plugins.fide import FIDE
from fide_plugins.options import make_options, without_images
from fide_plugins.space import Space
from fide_plugins.types import Float64
from fide_plugins.validation.options import check_names
from fide_plugins.validation.points import new_seed, standard_deviation
from fide_plugins.views import Views

__all__ = ["Settings", "check_sampler", "check_space"]

_NO_TARGET = np.zeros((16, 16, 3), np.float32)
_ELSEWHERE = {  # arguments of FIDE and of other samplers that have another place here
    "x0": "is not taken here: enqueue a guess before the first trial, "
    "study.enqueue_trial({'x': 0.3, ...}), and the search begins there; else in the middle",
    "constraints": "is not taken here: give constraints_func, a function of a finished trial that "
    "returns numbers, <= 0 where it is valid, or let the objective say it, "
    "trial.set_constraint(name, value)",
}


def check_space(space: object) -> dict[str, BaseDistribution] | None:
    """Copy of a search space, or None; raises OptionError (a ValueError) for anything else."""
    if space is None:
        return None
    if isinstance(space, Mapping) and not space:
        raise OptionError(
            "search_space is empty, so nothing would be searched; name the parameters, or leave it "
            "out: then it is what the trials have in common"
        )
    named = isinstance(space, Mapping) and all(isinstance(name, str) for name in space)
    if not named or not all(isinstance(d, BaseDistribution) for d in space.values()):  # type: ignore[attr-defined]
        raise OptionError(
            "search_space must have distributions by name, such as "
            f"{{'x': FloatDistribution(0, 1)}}, not {space!r}"
        )
    return dict(space)  # type: ignore[call-overload,no-any-return]


def check_sampler(sampler: object) -> BaseSampler | None:
    """Return an Optuna sampler, or None; raises OptionError (a ValueError) for anything else."""
    if sampler is None or isinstance(sampler, BaseSampler):
        return sampler
    raise OptionError(f"independent_sampler must be an Optuna sampler, not {sampler!r}")


class Settings:
    """The settings of a sampler; those of its optimizers are as for `FIDE`, which raises as well.

    target: targets and weights of the views; None: nothing is proposed, which leaves CMA-ES.
    seed: None: that of the study.
    consider_pruned: whether pruned trials count, with their last intermediate value.
    """

    def __init__(
        self,
        target: Views | None,
        loss: str | Callable[..., object] | None,
        preset: str,
        sigma0: float,
        device: str,
        options: Mapping[str, Any],
        *,
        seed: int | None,
        artifact_store: Any,
        consider_pruned: bool,
    ) -> None:
        for name, instead in _ELSEWHERE.items():
            check_names(options, (name,), instead)
        self._made = make_options(preset, options)
        standard_deviation(sigma0)
        if target is None and (loss is not None or artifact_store is not None):
            raise OptionError("a loss of images and an artifact store need a target: set target=")
        self.target, self._loss, self._options = target, loss, options
        self._preset, self._sigma0, self._device = preset, sigma0, device
        self.seed = None if seed is None else new_seed(seed)
        self.consider_pruned = consider_pruned
        self.warnings = WarnOnce()
        self.images = None if target is None else ImageEvaluator(self._make_evaluator)
        """None without a target."""
        self.artifacts = None
        """None without an artifact store."""
        if artifact_store is not None:
            self.artifacts = ImageArtifacts(artifact_store, self.warnings)

    @property
    def problem(self) -> str | None:
        """Digest of target and loss; None without a target."""
        return None if self.images is None else self.images.problem

    def digest_of(self, space: Mapping[str, BaseDistribution]) -> str:
        """Eight characters; optimizers of one problem with equal ones and seeds ask the same.

        The problem has a digest of its own, see `images.ImageEvaluator.problem`: records of
        earlier versions lack that one, and count.
        """
        described = {name: _described(space[name]) for name in space}
        settings = [asdict(self._made), self._sigma0, self.target is None, described]
        text = json.dumps(settings, sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=4).hexdigest()

    def _make_evaluator(self) -> Evaluator:
        made = self._made
        return Evaluator(
            self.target,
            self._loss,
            made.encoder,
            device=self._device,
            for_network=made.has_network,
            **made.comparison,
        )

    def make(self, space: Space, seed: int, guess: Float64 | None = None, **changed: Any) -> FIDE:
        """Optimizer in a space; all share one encoder and one loss.

        guess: (dim,), its first candidate, around which it begins.
        """
        # memory is for the next target, which there never is
        options, loss = {"memory_mb": 0.0, **self._options, **changed}, self._loss
        target: object = self.target
        if self.images is None:
            target = _NO_TARGET
            options = without_images(options)
        else:
            options["encoder"], loss = self.images.evaluator.encoder, self.images.evaluator.loss
        return FIDE(
            space,
            target,
            loss=loss,
            seed=seed,
            x0=guess,
            sigma0=self._sigma0,
            preset=self._preset,
            device=self._device,
            **options,
        )

    def first_candidate(self, space: Space, seed: int) -> Float64:
        """First candidate (dim,) in a space."""
        # without groups, which are of the parameters of the study, and do not change this one
        first: Float64 = self.make(space, seed, groups=None).ask(1)[0]
        return first


def _described(distribution: BaseDistribution) -> str:
    try:
        return distribution_to_json(distribution)
    except TypeError:  # a study in memory may have choices that are no JSON
        choices = distribution.choices if isinstance(distribution, CategoricalDistribution) else ()
        return json.dumps([getattr(one, "__qualname__", None) or repr(one) for one in choices])
