"""A head by flow matching: a velocity that carries the prior to the posterior.

Lipman et al. 2023, arXiv:2210.02747; for posteriors Wildberger et al. 2023, arXiv:2305.17161; on
the circle Chen and Lipman 2024, arXiv:2302.03660.

Notation
--------
w : (B, d) coordinates of the flow; Phi^-1(u) on an ordinary axis, u itself on a periodic one, so
    that the uniform prior is N(0, 1), or uniform on the circle, and all mass stays in the cube
t : time, 0: prior, 1: posterior
v : (B, d) velocity dw / dt

Training takes w_0 from the prior and the truth w_1, and regresses on the velocity of the straight
line (on a circle: of the shorter arc) between them.  Samples follow v from the prior.  The density
is that of the prior where v leads back to, times exp(-integral of the divergence); the divergence
is exact: d products of v's Jacobian, for some points at a time.

On an ordinary axis the network gives a mean m and a standard deviation s, and v is what would carry
the prior to N(m, s^2): exact for a Gaussian, and steep where the posterior is narrow.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from fide_plugins.learning.axes import fourier, frequencies

__all__ = ["Flow"]

_STEPS = 8  # of the ODE, each of four velocities
_DRAWS = 8  # of time and prior, for each picture of a batch
_LATE = 3.0  # power: how many of the times are near 1, where narrow posteriors are formed
_CHUNK = 512  # points whose divergence is computed together
_EDGE = 1e-6  # of the cube; Phi^-1 is infinite there
_SMALLEST, _LARGEST = 5e-3, 2.0  # standard deviations of w
_TURN = 12**-0.5  # standard deviation of a uniform turn, the scale of a velocity on a circle

Velocity = Callable[[Tensor, float], Tensor]
Pair = tuple[Tensor, Tensor]


class Flow(nn.Module):
    """p(u) as the flow of a velocity from the prior.

    width: of the features.  periodic: (d,) bool.  hidden: units.  blocks: residual ones.
    """

    periodic: Tensor

    def __init__(self, width: int, periodic: Tensor, hidden: int = 128, blocks: int = 3) -> None:
        super().__init__()
        d = len(periodic)
        self.register_buffer("periodic", periodic, persistent=False)
        self.context = nn.Linear(width, hidden * (blocks + 1))
        self.time = nn.Linear(frequencies(), hidden * (blocks + 1))
        self.place = nn.Linear(d * (frequencies() + 1), hidden)
        self.inner = nn.ModuleList(nn.Linear(hidden, hidden) for _ in range(blocks))
        self.outer = nn.ModuleList(nn.Linear(hidden, hidden) for _ in range(blocks))
        self.out = nn.Linear(hidden, d * 4)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def loss(self, places: Tensor, vector: Tensor, u: Tensor, generator: torch.Generator) -> Tensor:
        """Mean squared error of the velocity at u (B, d); see `Head` for the features."""
        w1 = self._coordinates(u).repeat_interleave(_DRAWS, 0)
        time = torch.rand((len(w1), 1), generator=generator)  # of the clock that is even in steps
        w0 = self._prior(len(w1), generator)
        t = _late(time)
        way = self._way(w0, w1)  # (B, d)
        context = self.context(vector).repeat_interleave(_DRAWS, 0)
        error = (self._velocity(w0 + t * way, time, context) - way) / self._scale()
        return error.square().sum(dim=-1).mean()

    def log_prob(self, places: Tensor, vector: Tensor, u: Tensor) -> Tensor:
        """See `Head`."""
        context = self.context(vector)
        parts = zip(torch.split(u, _CHUNK), torch.split(context, _CHUNK), strict=True)
        return torch.cat([self._log_prob(some, given) for some, given in parts])

    def sample(self, places: Tensor, vector: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """See `Head`."""
        context = self.context(vector).expand(n, -1)
        w = self._prior(n, generator)
        times = torch.linspace(0, 1, _STEPS + 1)
        for now, then in pairwise(times.tolist()):
            w = _step(partial(self._at, context=context), w, now, then)
        return torch.where(self.periodic, w - w.floor(), torch.special.ndtr(w)).clamp(0.0, 1.0)

    def _log_prob(self, u: Tensor, context: Tensor) -> Tensor:
        w = self._coordinates(u)
        start, change = _normal(w), torch.zeros(len(u), 1)
        state = torch.cat([w, change], dim=1)

        def rate(state: Tensor, time: float) -> Tensor:
            v, divergence = self._with_divergence(state[:, :-1], time, context)
            return torch.cat([v, divergence[:, None]], dim=1)

        times = torch.linspace(1, 0, _STEPS + 1)
        for now, then in pairwise(times.tolist()):
            state = _step(rate, state, now, then)
        straight = torch.where(self.periodic, torch.zeros(()), _normal(state[:, :-1]) - start)
        return straight.sum(dim=-1) + state[:, -1]

    def _with_divergence(self, w: Tensor, time: float, context: Tensor) -> tuple[Tensor, Tensor]:
        """Velocity (B, d) and its divergence (B,)."""

        def at(w: Tensor) -> Tensor:
            return self._at(w, time, context)

        def column(axis: Tensor) -> tuple[Tensor, Tensor]:
            v, change = cast(Pair, torch.func.jvp(at, (w,), (axis.expand_as(w),)))
            return v, (change * axis).sum(dim=-1)

        each: Any = torch.func.vmap(column, out_dims=(None, 0))  # type: ignore[arg-type]
        v, diagonal = each(torch.eye(w.shape[1]))
        return v, diagonal.sum(dim=0)

    def _at(self, w: Tensor, time: float, context: Tensor) -> Tensor:
        """Derivative of w by time, of the clock that is even in steps."""
        now = torch.full((len(w), 1), time)
        faster: float = _LATE * (1 - time) ** (_LATE - 1)  # dt / dtime
        return self._velocity(w, now, context) * faster

    def _velocity(self, w: Tensor, time: Tensor, context: Tensor) -> Tensor:
        """Velocity v at w (B, d), times (B, 1) of the even clock, given the picture's part."""
        u = torch.where(self.periodic, w, torch.special.ndtr(w))
        seen = torch.where(self.periodic, torch.zeros(()), w)[..., None]
        waves = torch.cat([fourier(u, self.periodic), seen], dim=-1).flatten(1)
        given = context + self.time(fourier(time, torch.tensor([False])).flatten(1))
        first, *others = given.chunk(len(self.inner) + 1, dim=-1)
        h = F.gelu(self.place(waves) + first)
        for inner, outer, more in zip(self.inner, self.outer, others, strict=True):
            h = h + outer(F.gelu(inner(h) + more))
        mean, spread, back, free = self.out(h).unflatten(-1, (-1, 4)).unbind(-1)
        t = _late(time)
        std = _SMALLEST * (_LARGEST / _SMALLEST) ** torch.sigmoid(spread + 2.0)
        straight = _towards(w, mean, std, t)
        turn = 2 * math.pi * w
        around = (mean * turn.cos() + back * turn.sin()) / (1 - t + std) + free
        return torch.where(self.periodic, _TURN * around, straight)

    def _coordinates(self, u: Tensor) -> Tensor:
        inside = torch.special.ndtri(u.clamp(_EDGE, 1 - _EDGE))
        return torch.where(self.periodic, u, inside)

    def _prior(self, n: int, generator: torch.Generator) -> Tensor:
        shape = (n, len(self.periodic))
        uniform = torch.rand(shape, generator=generator)
        return torch.where(self.periodic, uniform, torch.randn(shape, generator=generator))

    def _way(self, w0: Tensor, w1: Tensor) -> Tensor:
        apart = w1 - w0
        return torch.where(self.periodic, apart - apart.round(), apart)

    def _scale(self) -> Tensor:
        return torch.where(self.periodic, _TURN, 1.0)


def _late(time: Tensor) -> Tensor:
    """Time t at a time of the clock that is even in steps: slow near 1."""
    return 1 - (1 - time) ** _LATE


def _towards(w: Tensor, mean: Tensor, std: Tensor, t: Tensor) -> Tensor:
    """Velocity (B, d) of the flow from N(0, 1) to N(mean, std^2)."""
    variance = (t * std).square() + (1 - t).square()
    return mean + (t * std.square() - (1 - t)) / variance * (w - t * mean)


def _normal(w: Tensor) -> Tensor:
    """Logarithm of the density of N(0, 1), up to a constant."""
    return -0.5 * w.square()


def _step(rate: Velocity, w: Tensor, now: float, then: float) -> Tensor:
    """A step of Runge and Kutta's method of order 4."""
    h = then - now
    a = rate(w, now)
    b = rate(w + 0.5 * h * a, now + 0.5 * h)
    c = rate(w + 0.5 * h * b, now + 0.5 * h)
    d = rate(w + h * c, then)
    return w + h / 6 * (a + 2 * b + 2 * c + d)
