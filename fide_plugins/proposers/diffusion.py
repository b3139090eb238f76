"""The published proposer: a denoiser trained along with the search (Algorithm 1, lines 5 and 8).

Nothing in this module knows the search, the renderer or the loss.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fide_plugins.denoiser.network import ParameterTransformer, full_precision
from fide_plugins.denoiser.training import (
    Objective,
    Preconditioner,
    adam_state,
    all_finite,
    euler,
    fit,
    load_adam_state,
    x_loss,
    x_prediction,
)
from fide_plugins.errors import OptionError
from fide_plugins.options import Options
from fide_plugins.proposers.base import Proposer
from fide_plugins.runtime.devices import resolve_device
from fide_plugins.runtime.messages import warn_user
from fide_plugins.runtime.schema import (
    Plain,
    Schema,
    Sides,
    array,
    check,
    numbers,
    side,
    table,
    whole,
)
from fide_plugins.runtime.threads import user_threads
from fide_plugins.types import Float64
from fide_plugins.validation.options import schedule as checked_schedule

_DEFAULTS = Options()
MOST_PROPOSALS = 4096  # that are denoised together


class DiffusionProposer(Proposer):
    """Diffusion in parameter space, conditioned on image features; defaults are the paper's.

    Parameters
    ----------
    dim : d, the number of parameters.
    seed : of the weights, the order of the examples and the noise.
    device : of the network; initial weights are the same on all.
    epochs, learning_rate, schedule : supplement S1.
    batch_size : the paper names none; 50 makes 200 steps of Adam a generation of k = 500.
    objective, precondition : see `denoiser.training`.
    **network : sizes of the `ParameterTransformer`.

    Raises
    ------
    OptionError
        if a count is below 1, the learning rate is not positive, or a schedule does not fall.
    """

    def __init__(
        self,
        dim: int,
        *,
        seed: int = 0,
        device: str | torch.device = "cpu",
        epochs: int = _DEFAULTS.epochs,
        learning_rate: float = _DEFAULTS.learning_rate,
        batch_size: int = _DEFAULTS.batch_size,
        schedule: Sequence[float] = _DEFAULTS.schedule,
        objective: Objective | None = None,
        precondition: Preconditioner = x_prediction,
        **network: Any,
    ) -> None:
        if dim < 1 or epochs < 1 or batch_size < 1:
            raise OptionError(f"at least 1 each: got {dim=}, {epochs=}, {batch_size=}")
        if not 0 < learning_rate < float("inf"):
            raise OptionError(f"a learning rate is positive and finite, got {learning_rate=}")
        self.dim, self.device = dim, resolve_device(device)
        self.epochs, self.learning_rate = epochs, learning_rate
        self.schedule = checked_schedule("schedule", schedule)
        self.objective: Objective = objective or x_loss
        self.precondition = precondition
        self.updates = 0
        self._batch_size = batch_size
        self._warned = False  # that training diverged
        self._sizes = network
        self._network: ParameterTransformer | None = None
        self._optimizer: torch.optim.Adam | None = None
        for_weights, for_noise = np.random.SeedSequence(seed).generate_state(2)
        self._weights_seed = int(for_weights)
        self._generator = torch.Generator(self.device).manual_seed(int(for_noise))

    @property
    def ready(self) -> bool:
        """True: as in Algorithm 1, the first proposals come from an untrained network."""
        return True

    def forget(self) -> None:
        """Keep the weights: they are carried on (Algorithm 1)."""

    @user_threads
    @torch.inference_mode(False)
    @torch.enable_grad()
    def update(
        self,
        x: Float64,
        tokens: Tensor,
        losses: Float64 | None,
        std: Float64,
        *,
        epochs: int | None = None,
        learning_rate: float | None = None,
    ) -> Tensor:
        """Train on parameters `x` (n, d) and the tokens (n, T, C) of their images; no `losses`.

        `std` (d,) is sqrt(diag Sigma) of the search distribution.
        `epochs`, `learning_rate`: of this training; None: the proposer's own.

        Returns the mean training loss of each epoch, on the device.  Training that diverges is
        undone, with a RuntimeWarning the first time; training that raises is undone, too.
        """
        rate = self.learning_rate if learning_rate is None else learning_rate
        network, optimizer = self._parts(*tokens.shape[1:])
        for group in optimizer.param_groups:
            group["lr"] = rate
        network.train()
        before = deepcopy((network.state_dict(), optimizer.state_dict()))
        noise_before = self._generator.get_state()
        try:
            with full_precision(self.device):
                history = fit(
                    network,
                    self.precondition,
                    self.objective,
                    optimizer,
                    self._tensor(x),
                    tokens,
                    self._tensor(std),
                    epochs=self.epochs if epochs is None else epochs,
                    batch_size=self._batch_size,
                    generator=self._generator,
                )
            diverged = not all_finite(network)
        except BaseException:
            network.load_state_dict(before[0])
            optimizer.load_state_dict(before[1])
            self._generator.set_state(noise_before)
            raise
        if diverged:
            network.load_state_dict(before[0])
            optimizer.load_state_dict(before[1])
            if not self._warned:
                self._warned = True
                warn_user(
                    f"training of the denoiser diverged with learning_rate={rate:g}; its "
                    "weights stay as they were: choose a lower one, such as 0.001"
                )
        self.updates += 1
        return history

    @user_threads
    @torch.no_grad()
    def propose(
        self,
        z: Float64,
        target: Tensor,
        mean: Float64,
        std: Float64,
        rng: np.random.Generator | None = None,
        *,
        schedule: tuple[float, ...] | None = None,
    ) -> Float64:
        """Denoise samples `z` (m, d) of the search distribution towards the target's tokens (T, C).

        `schedule`: times of its steps, which fall; None: the proposer's own.

        Returns (m, d), finite: where the network overflows, the sample itself.  Values may leave
        the unit cube.
        """
        times = self.schedule if schedule is None else schedule
        network, _ = self._parts(*target.shape)
        network.eval()
        noisy, spread = self._tensor(z), self._tensor(std)
        proposed = torch.empty_like(noisy)
        with full_precision(self.device):
            context = network.encode_context(target.to(self.device, torch.float32)[None])
            denoise = self.precondition(partial(network, context=context))
            for start in range(0, len(noisy), MOST_PROPOSALS):
                piece = slice(start, start + MOST_PROPOSALS)
                proposed[piece] = euler(denoise, noisy[piece], spread, times)
        x = proposed.cpu().numpy().astype(np.float64)
        return np.where(np.isfinite(x), x, z)

    @user_threads
    def state_dict(self) -> dict[str, Any]:
        """Everything that `update` changes, as a nested dict of tensors, ints and strings."""
        state: dict[str, Any] = {
            "updates": self.updates,
            "weights_seed": self._weights_seed,
            "generator": self._generator.get_state(),
        }
        if self._network is None or self._optimizer is None:
            return state
        weights = {k: v.detach().cpu().clone() for k, v in self._network.state_dict().items()}
        return state | {
            "image_tokens": self._network.image_tokens,
            "channels": self._network.channels,
            "weights": weights,
            "adam": adam_state(self._optimizer),
        }

    @user_threads
    @torch.inference_mode(False)
    def load_state_dict(self, state: Plain, sides: Sides | None = None, device: Any = None) -> None:
        """Continue bit for bit where `state_dict` was taken; numpy arrays serve as tensors.

        sides: T and C of the tokens, if they are known.  Raises ValueError if `state` is none.
        """
        _check(state, sides or {})
        self._weights_seed = int(state["weights_seed"])
        if "weights" in state:
            network, optimizer = self._parts(int(state["image_tokens"]), int(state["channels"]))
            weights = {k: torch.as_tensor(v, device="cpu") for k, v in state["weights"].items()}
            network.load_state_dict(weights)
            load_adam_state(optimizer, state["adam"])
        else:
            self._network = self._optimizer = None
        self.updates = int(state["updates"])
        self._generator.set_state(
            torch.as_tensor(state["generator"], dtype=torch.uint8, device="cpu")
        )

    @torch.inference_mode(False)
    def _parts(
        self, image_tokens: int, channels: int
    ) -> tuple[ParameterTransformer, torch.optim.Adam]:
        """The network and its Adam, made on first use."""
        if self._network is None or self._optimizer is None:
            generator = torch.Generator().manual_seed(self._weights_seed)
            network = ParameterTransformer(
                self.dim, image_tokens, channels, generator=generator, **self._sizes
            )
            self._network = network.to(self.device)
            self._optimizer = torch.optim.Adam(
                self._network.parameters(), lr=self.learning_rate, fused=True
            )
        known = (self._network.image_tokens, self._network.channels)
        if (image_tokens, channels) != known:
            raise OptionError(
                f"image tokens keep the shape (T, C) = {known} that the network was made for, "
                f"got {(image_tokens, channels)}; make a new proposer for other images"
            )
        return self._network, self._optimizer

    def _tensor(self, values: Float64) -> Tensor:
        return torch.as_tensor(values, dtype=torch.float32, device=self.device)


def _check(state: Mapping[str, Any], sides: Sides) -> None:
    """Raise ValueError unless `state` is that of a denoiser."""
    schema: dict[str, Schema] = {
        "updates": whole(),
        "weights_seed": whole(high=2**32),
        "generator": array("bytes", kind="u"),
    }
    if "weights" in state:
        moments: Schema = {"step": numbers, "exp_avg": numbers, "exp_avg_sq": numbers}
        schema |= {"image_tokens": side("T"), "channels": side("C")}
        schema |= {"weights": table(numbers), "adam": table(moments)}
    check(state, schema, dict(sides), "proposer")
