"""What a sampler was made with."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution, distribution_to_json
from optuna.samplers import BaseSampler

from fide_adapters.optuna_parts.artifacts import ImageArtifacts
from fide_adapters.optuna_parts.eye import Eye
from fide_adapters.optuna_parts.voice import Voice
from fide_plugins.errors import OptionError
from fide_plugins.fide import FIDE
from fide_plugins.images import Float32
from fide_plugins.points import standard_deviation
from fide_plugins.presets import make_options

__all__ = ["Recipe", "Settings", "check_sampler", "check_space"]

_NO_TARGET = np.zeros((16, 16, 3), np.float32)


def check_space(space: object) -> dict[str, BaseDistribution] | None:
    """Copy of a search space, or None; OptionError (a ValueError) if it is something else."""
    if space is None:
        return None
    named = isinstance(space, Mapping) and all(isinstance(name, str) for name in space)
    if not named or not all(isinstance(d, BaseDistribution) for d in space.values()):  # type: ignore[attr-defined]
        raise OptionError(
            "search_space must have distributions by name, such as "
            f"{{'x': FloatDistribution(0, 1)}}, not {space!r}"
        )
    return dict(space)  # type: ignore[call-overload,no-any-return]


def check_sampler(sampler: object) -> BaseSampler | None:
    """Return a sampler of Optuna's, or None; OptionError (a ValueError) if it is none."""
    if sampler is None or isinstance(sampler, BaseSampler):
        return sampler
    raise OptionError(f"independent_sampler must be a sampler of Optuna's, not {sampler!r}")


@dataclass(frozen=True)
class Recipe:
    """How the optimizer of a search space is made.

    target: (H, W, 3); None: nothing is proposed, which leaves CMA-ES.
    Others as for `FIDE`, and raise what it raises.
    """

    target: Float32 | None
    preset: str
    sigma0: float
    device: str
    options: Mapping[str, Any]

    def __post_init__(self) -> None:
        make_options(self.preset, self.options)
        standard_deviation(self.sigma0)
        if "seed" in self.options or "loss" in self.options:
            raise OptionError("seed and loss belong to the sampler")

    @property
    def encoder(self) -> str:
        """Name of the encoder."""
        return make_options(self.preset, self.options).encoder

    def digest_of(self, space: Mapping[str, BaseDistribution]) -> str:
        """Eight characters, equal for optimizers that ask alike, if their seeds are equal."""
        options = asdict(make_options(self.preset, self.options))
        described = {name: distribution_to_json(space[name]) for name in space}
        text = json.dumps([options, self.sigma0, self.target is None, described], sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=4).hexdigest()

    def make(self, dim: int, seed: int) -> FIDE:
        """Optimizer of so many parameters, at least one."""
        options = dict(self.options)
        target = self.target
        if target is None:
            target = _NO_TARGET
            options |= {"proposer": "none", "encoder": "dense"}
        return FIDE(
            dim,
            target,
            seed=seed,
            sigma0=self.sigma0,
            preset=self.preset,
            device=self.device,
            **options,
        )


@dataclass(frozen=True)
class Settings:
    """What a sampler was made with.

    seed: None: that of the study.
    eye: None without a target.
    artifacts: None without a store.
    consider_pruned: whether pruned trials count, with their last value.
    """

    recipe: Recipe
    seed: int | None
    eye: Eye | None
    artifacts: ImageArtifacts | None
    consider_pruned: bool
    voice: Voice = field(default_factory=Voice)
