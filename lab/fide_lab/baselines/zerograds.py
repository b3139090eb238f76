"""ZeroGrads (Fischer and Ritschel 2024): gradients of a small network that imitates the loss.

Each step evaluates points around the present parameter, improves the parameter by the gradient of
the network, and then the network by what the points have shown.  As published, for few parameters:
three hidden layers of 64 units with leaky ReLUs, the last layer's output included; every offset is
used with both signs; points are shifted once more before they are rendered, by a tenth of sigma;
three steps of Adam for the parameter, then three for the network.

It deviates where the parameter itself is evaluated at each step, which counts here: a render
more; where losses are divided by the mean of the first step's; where points and the parameter
are kept in the box; and in the learning rates, which were chosen for the unit box on four functions
of 5 to 20 parameters, in races with the published program.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fide_lab.baselines.base import Baseline
from fide_plugins.runtime.threads import timed
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import positive

M = TypeVar("M", bound=nn.Module)


def make(
    build: Callable[[], M], generator: torch.Generator, dtype: torch.dtype = torch.float32
) -> M:
    """Module of linear layers, uniform in +-1 / sqrt(inputs), and layer norms."""
    with torch.device("meta"):
        module = build()
    module.to_empty(device="cpu")
    with torch.no_grad():
        for part in module.modules():
            if isinstance(part, nn.Linear):
                bound = part.in_features**-0.5
                part.weight.uniform_(-bound, bound, generator=generator)
                part.bias.uniform_(-bound, bound, generator=generator)
            elif isinstance(part, nn.LayerNorm):
                part.reset_parameters()
    return module.to(dtype)


HIDDEN, LAYERS = 64, 3
STEPS = 3  # of Adam, for the parameter and for the network
SMOOTHING = 0.1  # offset before rendering, in units of sigma


class Proxy(nn.Module):
    """The network: points (n, d) to losses (n,)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        sizes = [dim, *[HIDDEN] * LAYERS, 1]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))

    def forward(self, x: Tensor) -> Tensor:
        """(n, d) -> (n,)."""
        for layer in self.layers:
            x = F.leaky_relu(layer(x))
        return x[:, 0]

    def gradient(self, x: Tensor) -> Tensor:
        """Gradient (d,) of the imitated loss at a point (d,)."""
        x = x.detach().requires_grad_()
        (gradient,) = torch.autograd.grad(self(x[None])[0], x)
        return gradient


class ZeroGrads(Baseline):
    """ZeroGrads from the center of the box.

    popsize: offsets with both signs and the parameter, at least 3, an even number less one;
        None: 21.
    learning_rate: of the parameter.
    proxy_rate: of the network.
    sigma0: standard deviation of the offsets, at all times.

    The other options are those of `Baseline`.  Raises OptionError.
    """

    name: ClassVar[str] = "zerograds"

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        learning_rate: float = 1e-3,
        proxy_rate: float = 1e-2,
        **options: Any,
    ) -> None:
        super().__init__(dim, target, **options)
        self.popsize -= self.popsize % 2 == 0
        self.learning_rate = positive("learning_rate", learning_rate)
        self.proxy_rate = positive("proxy_rate", proxy_rate)
        self._rng = np.random.default_rng(self.seed)
        generator = torch.Generator().manual_seed(int(self._rng.integers(2**63)))
        self._proxy = make(lambda: Proxy(self.dim), generator)
        self._theta = torch.full((self.dim,), 0.5)
        self._theta_adam = torch.optim.Adam([self._theta], lr=self.learning_rate)
        self._proxy_adam = torch.optim.Adam(self._proxy.parameters(), lr=self.proxy_rate)
        self._scale = 0.0  # of losses; not yet known
        self._unshifted: dict[bytes, Float64] = {}  # points of this step, as the network sees them

    def recommend(self) -> Float64:
        """The parameter (dim,)."""
        return self._theta.numpy().astype(np.float64)

    def _sample(self) -> Float64:
        theta = self.recommend()
        offsets = self.sigma0 * self._rng.standard_normal((self.popsize // 2, self.dim))
        around = theta + np.concatenate([offsets, -offsets])  # (popsize - 1, d), antithetic
        shift = SMOOTHING * self.sigma0 * self._rng.standard_normal(around.shape)
        points = np.clip(around, 0.0, 1.0)
        rendered = np.clip(around + shift, 0.0, 1.0)
        self._unshifted |= {y.tobytes(): x for x, y in zip(points, rendered, strict=True)}
        return np.concatenate([rendered, theta[None]])

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        self._population.forget_pending()  # the network learns from the points of one step only
        learned = [x.tobytes() in self._unshifted for x in X] & np.isfinite(losses)
        points = [self._unshifted[x.tobytes()] for x in X[learned]]
        self._unshifted.clear()
        with timed(self.times, "train"):
            for _ in range(STEPS):
                self._theta.grad = self._proxy.gradient(self._theta)
                self._theta_adam.step()
                self._theta.clamp_(0.0, 1.0)
            if points:
                self._improve_proxy(np.array(points), losses[learned])

    def _improve_proxy(self, points: Float64, losses: Float64) -> None:
        if self._scale == 0.0:
            self._scale = float(np.abs(losses).mean()) or 1.0
        x = torch.as_tensor(points, dtype=torch.float32)
        y = torch.as_tensor(losses / self._scale, dtype=torch.float32)
        for _ in range(STEPS):
            self._proxy_adam.zero_grad()
            F.mse_loss(self._proxy(x), y).backward()  # type: ignore[no-untyped-call]
            self._proxy_adam.step()

    def _default_popsize(self) -> int:
        return 21

    def _smallest_popsize(self) -> int:
        return 3
