"""The sampler of parameters that are not searched together."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution
from optuna.samplers import RandomSampler
from optuna.study import Study
from optuna.trial import FrozenTrial

__all__ = ["NumberedSampler"]


class NumberedSampler(RandomSampler):
    """Uniform parameters from (seed, number of the trial, name of the parameter).

    With a plain `RandomSampler` all workers of equal seed would begin with the same parameters.
    """

    def __init__(self, seed: int | None = None) -> None:
        super().__init__()  # whose generator is not used, and takes no seed beyond 32 bits
        self._entropy = np.random.SeedSequence(seed).entropy

    def reseed_rng(self) -> None:
        """Continue with a seed from the operating system."""
        super().reseed_rng()
        self._entropy = np.random.SeedSequence().entropy

    def sample_independent(
        self,
        study: Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        """Uniform value, equal for equal trial number and name."""
        key = (trial.number, zlib.crc32(param_name.encode()))
        seeds = np.random.SeedSequence(self._entropy, spawn_key=key).generate_state(1)
        once = RandomSampler(int(seeds[0]))
        return once.sample_independent(study, trial, param_name, param_distribution)
