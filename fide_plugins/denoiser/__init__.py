"""The conditional denoiser: it estimates the parameters that made an image.

Shapes: B examples, d parameters, T image tokens of C channels.  Noise is s = t * std, with std (d,)
= sqrt(diag Sigma) at time t = 1; z = x + s * eps, eps ~ N(0, I).
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
