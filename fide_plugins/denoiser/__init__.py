"""The conditional denoiser: it estimates the parameters that made an image.

The files know each other only as callables:

=================  ================================================================
`network`          the transformer of supplement S1: image tokens in, parameters out
`training`         the objective, and Adam on the pairs of a population
`sampling`         meaning of the network's output; Euler's method on the reverse-time ODE
=================  ================================================================

Notation
--------
d : number of parameters
B : batch
T, C : image tokens, and channels of each
x : [B, d] clean parameters
s : [B, d] standard deviation of the noise, one number for each parameter
z : [B, d] noisy parameters, z = x + s * eps, eps ~ N(0, I)
x_hat : [B, d] the denoiser's estimate of x given z, s and the image
std : [d] sqrt(diag Sigma), the noise at the end of the diffusion process (time 1)
t : time in (0, 1]; s = t * std
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from torch import Tensor

__all__ = ["Denoise", "Network"]

Network: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""(z [B, d], s [B, d]) -> [B, d], the raw output of a network whose image is already bound."""

Denoise: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""(z [B, d], s [B, d]) -> x_hat [B, d]; a preconditioner makes one out of a Network."""
