"""Training by Adam on pairs of parameters and images, and sampling (Algorithm 1, lines 5 and 8).

B examples, d parameters, T image tokens of C channels.  Noise is s = t * std, with std (d,) =
sqrt(diag Sigma) at time t = 1; z = x + s * eps, eps ~ N(0, I).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, TypeAlias

import torch
from torch import Tensor, nn

from fide_plugins.denoiser.network import ParameterTransformer

Network: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""(z [B, d], s [B, d]) -> [B, d], the raw output of a network whose image is already bound."""
Denoise: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""(z [B, d], s [B, d]) -> x_hat [B, d]."""
Preconditioner: TypeAlias = Callable[[Network], Denoise]
"""Says what the output of a network means."""
Objective: TypeAlias = Callable[[Denoise, Tensor, Tensor, torch.Generator], Tensor]
"""Scalar loss of a denoiser on clean parameters x (B, d), noise `std` (d,) at time 1."""

CENTER = 0.5  # the start of every search; Algorithm 1 counts parameters from there (mu = 0)


def x_prediction(network: Network) -> Denoise:
    """x_hat = network(z, s), both relative to the center of the unit cube."""
    return lambda z, s: CENTER + network(z - CENTER, s)


def x_loss(denoise: Denoise, x: Tensor, std: Tensor, generator: torch.Generator) -> Tensor:
    """Objective of the paper: || x_hat(x + s * eps, s) - x ||^2, s = t * std, t ~ U(0, 1).

    S1: the timestep differs between parameters, and sqrt(diag Sigma) is that at the end of the
    diffusion process.  So one t is drawn for each example, and the network gets the vector s.
    """
    t = torch.rand(len(x), 1, generator=generator, device=x.device, dtype=x.dtype)
    s = t * std  # (B, d)
    eps = standard_normal(x.shape, x, generator)
    return (denoise(x + s * eps, s) - x).square().mean()


def standard_normal(shape: tuple[int, ...], like: Tensor, generator: torch.Generator) -> Tensor:
    """Draw from N(0, 1), in the precision of `like` and where it is."""
    return torch.randn(shape, generator=generator, device=like.device, dtype=like.dtype)


@torch.no_grad()
def euler(denoise: Denoise, z: Tensor, std: Tensor, schedule: Sequence[float]) -> Tensor:
    """Integrate `z` [B, d] from time schedule[0] to 0 by Euler's method (Karras et al. 2022).

    A step from t to t' keeps the fraction t'/t of the noise: z' = x_hat + (t' / t) * (z - x_hat).
    std: [d], noise at time 1.  Parameters with std = 0 become the estimate of `denoise`.
    """
    for t, later in pairwise([*schedule, 0.0]):
        x_hat = denoise(z, (t * std).expand_as(z))
        z = x_hat + (later / t) * (z - x_hat)
    return z


def fit(
    network: ParameterTransformer,
    precondition: Preconditioner,
    objective: Objective,
    optimizer: torch.optim.Optimizer,
    x: Tensor,
    tokens: Tensor,
    std: Tensor,
    *,
    epochs: int,
    batch_size: int,
    generator: torch.Generator,
) -> Tensor:
    """Train for `epochs` passes over the pairs (x [n, d], tokens [n, T, C]), in random order.

    tokens: may be on another device than x, if that has too little memory for all of them.
    batch_size: size of a minibatch; the last one of an epoch may be smaller.

    Returns the mean loss of each epoch, [epochs], on the device.
    """
    losses = torch.zeros(epochs, device=x.device, dtype=x.dtype)
    for epoch in range(epochs):
        order = torch.randperm(len(x), generator=generator, device=x.device)
        for batch in torch.split(order, batch_size):
            context = network.encode_context(tokens[batch.to(tokens.device)].to(x))
            denoise = precondition(partial(network, context=context))
            loss = objective(denoise, x[batch], std, generator)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            losses[epoch] += loss.detach() * (len(batch) / len(x))
    return losses


def all_finite(network: nn.Module) -> bool:
    """Whether all weights are finite; waits for a GPU only once."""
    finite = [weight.detach().isfinite().all() for weight in network.parameters()]
    return bool(torch.stack(finite).all())


def adam_state(optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Adam's moments as {weight's number: {"step", "exp_avg", "exp_avg_sq"}}, copied to the CPU."""
    moments = optimizer.state_dict()["state"]
    return {
        str(number): {name: value.detach().cpu().clone() for name, value in entry.items()}
        for number, entry in moments.items()
    }


def load_adam_state(optimizer: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Restore the state that `adam_state` returned; accepts NumPy arrays.

    Raises ValueError unless all moments are present and match their weights; Adam does not check.
    """
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    if sorted(map(int, state)) not in ([], list(range(len(weights)))):
        raise ValueError(f"moments of {len(state)} weights, and there are {len(weights)}")
    moments = {
        int(number): {
            name: torch.as_tensor(value, device="cpu").clone() for name, value in entry.items()
        }
        for number, entry in state.items()
    }
    for number, entry in moments.items():
        weight = weights[number]
        shapes = {"step": torch.Size(), "exp_avg": weight.shape, "exp_avg_sq": weight.shape}
        found = {name: value.shape for name, value in entry.items()}
        if found != shapes or any(value.dtype != weight.dtype for value in entry.values()):
            raise ValueError(f"moments of weight {number} like {found}, not {shapes}")
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": moments, "param_groups": groups})
