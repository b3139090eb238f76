"""Sampling of the posterior p(x | image), for x uniform in the unit cube (Sec. 4.1).

The diffusion model of `proposers.diffusion` is trained on uniform samples of the cube and started
from pure noise: its samples cover all modes of the posterior.  Its first step, where the noise is
so large that z carries no information, is the regression E[x | image], which averages the modes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from fide_plugins.denoiser import Denoise, Network
from fide_plugins.denoiser.sampling import whitened
from fide_plugins.denoiser.training import WhitenedLoss
from fide_plugins.errors import OptionError
from fide_plugins.proposers.diffusion import DiffusionProposer
from fide_plugins.runtime.schema import GENERATOR, Schema, anything, array, check, maybe, row
from fide_plugins.types import Float64

__all__ = ["PosteriorSampler"]

BOX_STD = 12**-0.5  # of the uniform law on [0, 1]
LARGEST, SMALLEST = 20.0, 0.02  # noise at the two ends of sampling, in units of BOX_STD
SMALLEST_STD = 1e-3  # of a channel of tokens that is normalized


class PosteriorSampler:
    """Samples of x given an image, for x uniform in the unit cube.

    Parameters
    ----------
    dim : d, the number of parameters.
    steps : of Euler's method for a sample; noise levels fall geometrically.
    seed : of everything random.
    **options : of the `DiffusionProposer` (epochs, learning_rate, batch_size, device, width, ...).

    Raises
    ------
    OptionError
        if `steps` is below 1, or as the `DiffusionProposer`.
    """

    def __init__(self, dim: int, *, steps: int = 18, seed: int = 0, **options: Any) -> None:
        if steps < 1:
            raise OptionError(f"sampling takes at least one step, got {steps=}")
        for_proposer, for_samples = np.random.SeedSequence(seed).spawn(2)
        self.proposer = DiffusionProposer(
            dim,
            seed=int(for_proposer.generate_state(1)[0]),
            objective=WhitenedLoss(),
            precondition=_whiten_box,
            **options,
        )
        self._mean, self._std = np.full(dim, 0.5), np.full(dim, BOX_STD)
        self._schedule = tuple(np.geomspace(LARGEST, SMALLEST, steps).tolist())
        self._rng = np.random.default_rng(for_samples)
        self._scale: tuple[Tensor, Tensor] | None = None

    def update(
        self,
        x: Float64,
        tokens: Tensor,
        *,
        epochs: int | None = None,
        learning_rate: float | None = None,
    ) -> Tensor:
        """Train on uniform `x` (n, d) and the tokens (n, T, C) of their images.

        epochs, learning_rate: of this training; None: the proposer's.

        Returns the mean loss of each epoch; 1 means that nothing was learned.
        """
        if self._scale is None:  # channels of the first images get mean 0 and variance 1
            spread = tokens.std((0, 1), correction=0).clamp_min(SMALLEST_STD)
            self._scale = tokens.mean((0, 1)), spread
        return self.proposer.update(
            x,
            self._normalize(tokens),
            None,
            self._std,
            epochs=epochs,
            learning_rate=learning_rate,
        )

    def fit(self, x: Float64, tokens: Tensor, epochs: int) -> None:
        """Train on uniform `x` (n, d) and tokens (n, T, C), the last quarter with small steps."""
        last, rate = epochs // 4, self.proposer.learning_rate
        self.update(x, tokens, epochs=epochs - last)
        if last:
            self.update(x, tokens, epochs=last, learning_rate=rate / 5)

    def sample(self, n: int, target_tokens: Tensor) -> Float64:
        """Draw n parameter vectors for an image's tokens (T, C); (n, d), within the unit cube."""
        return self._solve(n, target_tokens, self._schedule)

    def regress(self, target_tokens: Tensor, n: int = 256) -> Float64:
        """Estimate E[x | image], (d,): one step from pure noise, averaged over n draws of it."""
        one_step: Float64 = self._solve(n, target_tokens, (LARGEST,)).mean(axis=0)
        return one_step

    def state_dict(self) -> dict[str, Any]:
        """Everything that training and sampling change."""
        return {
            "proposer": self.proposer.state_dict(),
            "scale": None if self._scale is None else list(self._scale),
            "rng": self._rng.bit_generator.state,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put back what `state_dict` gave; numpy arrays serve as tensors; ValueError if none."""
        check(state, _SCHEMA, {})
        self.proposer.load_state_dict(state["proposer"])
        self._scale = None  # that of a state before training
        if state["scale"] is not None:
            mean, spread = (torch.as_tensor(part) for part in state["scale"])
            self._scale = mean, spread
        self._rng.bit_generator.state = state["rng"]

    def _solve(self, n: int, target_tokens: Tensor, schedule: tuple[float, ...]) -> Float64:
        noise = self._rng.standard_normal((n, self.proposer.dim))
        z = self._mean + schedule[0] * self._std * noise
        tokens = self._normalize(target_tokens)
        x = self.proposer.propose(z, tokens, self._mean, self._std, schedule=schedule)
        return np.clip(x, 0, 1)

    def _normalize(self, tokens: Tensor) -> Tensor:
        if self._scale is None:
            return tokens
        mean, spread = self._scale
        return (tokens - mean) / spread


_SCHEMA: Schema = {
    "proposer": anything,  # checks its own
    "scale": maybe(row(array("C"), array("C"))),
    "rng": GENERATOR,
}


def _whiten_box(network: Network) -> Denoise:
    return whitened(network, 0.5, BOX_STD)
