"""DiBO (Yun et al. 2025): posterior inference with diffusion models, in rounds.

Every round fits new networks to the best points so far (the buffer), in double precision:

1. x and y = -loss are standardized over the buffer; training points are drawn from it with weights
   exp(y), and shifted by N(0, 0.001^2).
2. Proxy: an ensemble of five perceptrons predicts y; the reward r is their mean + gamma * standard
   deviation.
3. Prior: a diffusion model of x.
4. Posterior: the prior's noise plus that of a trainable copy of it, brought to p_prior exp(r/alpha)
   by relative trajectory balance, 1/2 (log Z + alpha (log p_post - log p_prior) - r)^2 over whole
   chains: half of the steps with chains of its own, half with noised points from a pool of the
   buffer and all points seen in training, drawn with weights softmax(r).
5. Candidates: many samples of the posterior are improved by Adam on the score r + alpha log p_prior
   and the best `popsize` of them, clamped to the box, are evaluated.

It deviates from the authors' program: Adam climbs the score itself, not its exponential, and
without the divergence part of log p_prior; the first points are the center of the box and uniform
ones.  Variances are the program's: 31 from 7.6e-4 to 0.0207, of which it trains and samples with
all but the cleanest.  log p_prior is its own number, see `program_likelihood`: no likelihood, but a
strong pull to the mean of the buffer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import asdict, dataclass, fields
from functools import cached_property, partial
from itertools import chain
from math import log, pi
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fide_lab.baselines.base import Baseline
from fide_lab.baselines.zerograds import make
from fide_plugins.runtime.threads import timed, user_threads
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.options import one_of, positive
from fide_plugins.validation.points import whole_number

HARMONICS = 64
MEMBERS = 5


def perceptron(dim: int, width: int) -> nn.Sequential:
    """One layer in, three hidden ones, GELU after each, and one number out."""
    layers = [(nn.Linear(inputs, width), nn.GELU()) for inputs in (dim, width, width, width)]
    return nn.Sequential(*chain(*layers), nn.Linear(width, 1))


class Ensemble(nn.Module):
    """Predictions of the value; where its members disagree, the reward is higher."""

    def __init__(self, dim: int, width: int, gamma: float) -> None:
        super().__init__()
        self.gamma = gamma
        self.members = nn.ModuleList(perceptron(dim, width) for _ in range(MEMBERS))

    def forward(self, x: Tensor) -> Tensor:
        """Reward mean + gamma std (n,) of points (n, d)."""
        values = torch.stack([member(x)[:, 0] for member in self.members])  # (members, n)
        reward: Tensor = values.mean(dim=0) + self.gamma * values.std(dim=0)
        return reward


class Residual(nn.Module):
    """x + linear(gelu(norm(x)))."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm, self.linear = nn.LayerNorm(width), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """(n, width) -> (n, width)."""
        out: Tensor = x + self.linear(F.gelu(self.norm(x)))
        return out


class NoisePredictor(nn.Module):
    """Noise epsilon (n, d) in noisy points (n, d), told the time by its harmonics."""

    def __init__(self, dim: int, width: int, depth: int = 3) -> None:
        super().__init__()
        self.inward = nn.Linear(dim, width)
        self.mix = nn.Linear(width + 2 * HARMONICS, width)
        self.blocks = nn.Sequential(*(Residual(width) for _ in range(depth)))
        self.norm, self.outward = nn.LayerNorm(width), nn.Linear(width, dim)

    def forward(self, x: Tensor, t: Tensor) -> Tensor:
        """Noise (n, d) of points x (n, d) at times t (n,)."""
        k = torch.arange(1, HARMONICS + 1, dtype=x.dtype, device=x.device)
        phase = 2 * math.pi * t[:, None] * k  # (n, 64)
        h = self.mix(torch.cat([self.inward(x), phase.sin(), phase.cos()], dim=1))
        out: Tensor = self.outward(F.gelu(self.norm(self.blocks(h))))
        return out


Predict = Callable[[Tensor, Tensor], Tensor]

FIRST, LAST = 0.02, 1e-4  # variance of the noise of the noisiest and the cleanest step
MOST_SNR = 5.0  # Min-SNR weights (Hang et al. 2023)


def program_betas(steps: int) -> Tensor:
    """Variances (T + 1,) of the authors' program; for T = 30 from 0.0207 to 7.6e-4."""
    rank = torch.arange(steps + 1, 0, -1, dtype=torch.float64)
    return (FIRST - LAST) * rank / steps + LAST


class Diffusion:
    """The process of the first `steps` of the program's variances, without its network.

    i = 0 ... T-1   step of denoising, the noisiest first; time t = i / T
    beta            variance of the noise of a step, linear in i (`program_betas`)
    abar            product of (1 - beta) over this step and all cleaner ones
    predict(x, t)   the noise epsilon in x, (n, d)

    A denoising step is x' ~ N(mean, beta) with
    mean = (x - beta / sqrt(1 - abar) epsilon) / sqrt(1 - beta);
    a noising step, its reverse, x ~ N(sqrt(1 - beta) x', beta).

    The step after the first T is noise that every point has and that no step takes away.
    """

    def __init__(self, steps: int, dtype: torch.dtype) -> None:
        self.steps = steps
        every = program_betas(steps).to(dtype)
        self.beta = every[:steps]
        self.abar = (1 - every).flip(0).cumprod(0).flip(0)[:steps]
        self._time = torch.arange(steps).to(dtype) / steps

    def loss(self, predict: Predict, x: Tensor, generator: torch.Generator) -> Tensor:
        """Squared error of the predicted noise at random steps, weighted by min(5 / SNR, 1)."""
        i = torch.randint(self.steps, (len(x),), generator=generator, device=x.device)
        noise = draw_normal(x, generator)
        abar = self.abar[i, None]
        weight = (MOST_SNR * (1 - abar) / abar).clamp(max=1.0)
        error = predict(abar.sqrt() * x + (1 - abar).sqrt() * noise, self._time[i]) - noise
        return (weight * error.square()).mean()

    def mean(self, x: Tensor, noise: Tensor, i: int | Tensor) -> Tensor:
        """Mean of a denoising step from x, whose noise was predicted; i: number, or (n, 1)."""
        beta, abar = self.beta[i], self.abar[i]
        out: Tensor = (x - beta / (1 - abar).sqrt() * noise) / (1 - beta).sqrt()
        return out

    @torch.no_grad()
    def denoise(self, predict: Predict, x: Tensor, generator: torch.Generator) -> Tensor:
        """States (T + 1, n, d) of a chain that starts at noise x (n, d); the last is clean."""
        states = [x]
        for i in range(self.steps):
            noise = predict(x, self._time[i].expand(len(x)))
            x = self.mean(x, noise, i) + self.beta[i].sqrt() * draw_normal(x, generator)
            states.append(x)
        return torch.stack(states)

    @torch.no_grad()
    def noise(self, x: Tensor, generator: torch.Generator) -> Tensor:
        """States (T + 1, n, d) of a chain that ends at clean points x (n, d)."""
        states = [x]
        for beta in self.beta.flip(0):
            x = (1 - beta).sqrt() * x + beta.sqrt() * draw_normal(x, generator)
            states.append(x)
        return torch.stack(states[::-1])

    def log_ratio(self, states: Tensor, predict: Predict, reference: Predict) -> Tensor:
        """Log-likelihood ratio log p(chain) / q(chain), (n,), of two models; gradients for p.

        Both begin with the same standard normal law, and have the same variances.
        """
        before, after = states[:-1].flatten(0, 1), states[1:].flatten(0, 1)  # (T n, d)
        n = states.shape[1]
        i = torch.arange(self.steps, device=states.device).repeat_interleave(n)
        mine = self.mean(before, predict(before, self._time[i]), i[:, None])
        with torch.no_grad():
            other = self.mean(before, reference(before, self._time[i]), i[:, None])
        gain = (after - other).square() - (after - mine).square()
        ratio: Tensor = (gain.sum(dim=1) / (2 * self.beta[i])).view(self.steps, n).sum(dim=0)
        return ratio


def draw_normal(like: Tensor, generator: torch.Generator) -> Tensor:
    """Standard normal numbers of the shape of `like`."""
    return torch.randn(like.shape, generator=generator, dtype=like.dtype, device=like.device)


def program_likelihood(
    predict: Predict, x: Tensor, steps: int, generator: torch.Generator | None = None
) -> Tensor:
    """What the authors' program calls log p(x), (n,), of a model with so many steps.

    It means to integrate the probability-flow ODE from a point to noise, in y = x / sqrt(abar),
    where it is dy/dsigma = epsilon, sigma = sqrt((1 - abar) / abar).  It starts at the noisy end
    instead, at sigma = 0.63 for 30 steps, ends at the clean one, 0.028, and takes the density of
    N(0, 0.028^2) there.  Its times run backwards as well, one step of the 3/8 rule makes the whole
    way, and the divergence is that of x.  What remains is a strong pull to the mean of the buffer,
    with which the searches of the authors were made.

    Without a generator the divergence is left out; the program takes no gradient of it.
    """
    signs = None
    if generator is not None:
        coin = torch.randint(2, x.shape, generator=generator, device=x.device)
        signs = 2.0 * coin.to(x.dtype) - 1.0
    abar = (1 - program_betas(steps).flip(0)).cumprod(0)
    sigmas = ((1 - abar) / abar).sqrt()  # rising, (steps + 1,)
    clean, noisy = float(sigmas[0]), float(sigmas[-1])

    def flow(sigma: float, y: Tensor) -> tuple[Tensor, Tensor]:
        # 0 where the noise is least, 1 where it is largest; between them linear in its logarithm
        place = float(np.interp(log(sigma), sigmas.log().numpy(), range(len(sigmas))))
        t = x.new_tensor(place / (len(sigmas) - 1)).expand(len(x))
        return noise_and_divergence(predict, y * (1 + sigma**2) ** -0.5, t, signs)

    h = clean - noisy
    k1, g1 = flow(noisy, x)
    k2, g2 = flow(noisy + h / 3, x + h / 3 * k1)
    k3, g3 = flow(noisy + 2 * h / 3, x + h * (k2 - k1 / 3))
    k4, g4 = flow(clean, x + h * (k1 - k2 + k3))
    y = x + h / 8 * (k1 + 3 * (k2 + k3) + k4)
    gained = h / 8 * (g1 + 3 * (g2 + g3) + g4)
    log_normal = -0.5 * (y.square() / clean**2 + log(2 * pi * clean**2)).sum(dim=1)
    out: Tensor = log_normal + gained
    return out


def noise_and_divergence(
    predict: Predict, x: Tensor, t: Tensor, signs: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Predicted noise (n, d) and its divergence (n,) at x, estimated by signs; None: 0."""
    velocity = predict(x, t)
    if signs is None:
        return velocity, x.new_zeros(len(x))
    with torch.enable_grad():
        point = x.detach().requires_grad_()
        (slope,) = torch.autograd.grad((predict(point, t) * signs).sum(), point)
    return velocity, (slope * signs).sum(dim=1)


JITTER = 1e-3  # noise on training points
POOL_JITTER = 1e-2  # noise on points of the pool
RATE, POSTERIOR_RATE, SEARCH_RATE = 1e-3, 1e-4, 1e-2  # of Adam


_LEAST = {"posterior_epochs": 0, "search_epochs": 0, "diffusion_steps": 2}  # others: 1


@dataclass(frozen=True)
class RoundOptions:
    """What `DiBO` documents; OptionError (a ValueError) for an option out of range."""

    proxy_epochs: int = 50
    prior_epochs: int = 50
    posterior_epochs: int = 50
    search_epochs: int = 30
    proposals: int = 10
    diffusion_steps: int = 30
    alpha: float = 1e-4
    gamma: float = 1.0
    width: int = 512
    proxy_width: int = 256
    batch: int = 256

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if name in ("alpha", "gamma"):
                positive(name, value)
            else:
                whole_number(name, value, _LEAST.get(name, 1))


class Round:
    """Networks fitted to standardized points x (n, d) and values y (n,), the higher the better."""

    def __init__(
        self, options: RoundOptions, x: Tensor, y: Tensor, generator: torch.Generator
    ) -> None:
        self.options, self.x, self.y, self.generator = options, x, y, generator
        self.diffusion = Diffusion(options.diffusion_steps, x.dtype)

    @cached_property
    def proxy(self) -> Ensemble:
        """The reward, (n, d) -> (n,)."""
        o, dim = self.options, self.x.shape[1]
        ensemble = make(lambda: Ensemble(dim, o.proxy_width, o.gamma), self.generator, self.x.dtype)
        for member in ensemble.members:
            adam = torch.optim.Adam(member.parameters(), lr=RATE)
            for x, y in self._batches(o.proxy_epochs):
                _step(adam, F.mse_loss(member(x)[:, 0], y))
        ensemble.requires_grad_(False)
        return ensemble

    @cached_property
    def prior(self) -> NoisePredictor:
        """The diffusion model of the buffer."""
        dim, width = self.x.shape[1], self.options.width
        network = make(lambda: NoisePredictor(dim, width), self.generator, self.x.dtype)
        adam = torch.optim.Adam(network.parameters(), lr=RATE)
        for x, _ in self._batches(self.options.prior_epochs):
            _step(adam, self.diffusion.loss(network, x, self.generator))
        network.requires_grad_(False)
        return network

    @cached_property
    def posterior(self) -> Predict:
        """The prior's noise and that of its copy, trained by relative trajectory balance."""
        copy = deepcopy(self.prior).requires_grad_(True)
        predict = partial(_sum, self.prior, copy)
        log_z = self.x.new_zeros(()).requires_grad_()
        adam = torch.optim.Adam([log_z, *copy.parameters()], lr=POSTERIOR_RATE)
        pool, rewards = self.x, self.proxy(self.x)
        for _ in range(self.options.posterior_epochs):
            states = self._chains(predict, pool, rewards)
            reward = self.proxy(states[-1])
            ratio = self.diffusion.log_ratio(states, predict, self.prior)
            _step(adam, trajectory_balance(log_z, ratio, reward, self.options.alpha))
            pool, rewards = torch.cat([pool, states[-1]]), torch.cat([rewards, reward])
        copy.requires_grad_(False)
        return predict

    def candidates(self, n: int) -> Tensor:
        """The best n (n, d) of all samples, by their score."""
        posterior, several = self.posterior, []
        for _ in range(self.options.proposals):
            noise = self._noise(n * self.options.proposals)
            drawn = self.diffusion.denoise(posterior, noise, self.generator)[-1]
            several.append(self._improved(drawn))
        x = torch.cat(several)
        scores = torch.cat([self._score(part, self.generator) for part in several])
        return x[scores.argsort(descending=True, stable=True)[:n]]

    def _improved(self, x: Tensor) -> Tensor:
        """Points (n, d) after some steps of Adam uphill."""
        x = x.clone().requires_grad_()
        adam = torch.optim.Adam([x], lr=SEARCH_RATE)
        for _ in range(self.options.search_epochs):
            _step(adam, -self._score(x).sum())
        return x.detach()

    def _score(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Reward + alpha log p_prior, (n,); the latter's divergence only with a generator."""
        likelihood = program_likelihood(self.prior, x, self.options.diffusion_steps, generator)
        score: Tensor = self.proxy(x) + self.options.alpha * likelihood
        return score

    def _chains(self, predict: Predict, pool: Tensor, rewards: Tensor) -> Tensor:
        """States (T + 1, batch, d): with equal chance its own, or noised points of the pool."""
        batch = self.options.batch
        if int(torch.randint(2, (), generator=self.generator)) == 0:
            return self.diffusion.denoise(predict, self._noise(batch), self.generator)
        x = pool[rewards.softmax(0).multinomial(batch, True, generator=self.generator)]
        x = x + POOL_JITTER * draw_normal(x, self.generator)
        return self.diffusion.noise(x, self.generator)

    def _noise(self, n: int) -> Tensor:
        return draw_normal(self.x.new_empty(n, self.x.shape[1]), self.generator)

    def _batches(self, epochs: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Training points, drawn with weights exp(y), as many an epoch as the buffer holds."""
        weights = self.y.exp()
        for _ in range(epochs):
            order = weights.multinomial(len(self.y), True, generator=self.generator)
            for chosen in torch.split(order, self.options.batch):
                x = self.x[chosen]
                yield x + JITTER * draw_normal(x, self.generator), self.y[chosen]


def trajectory_balance(log_z: Tensor, ratio: Tensor, reward: Tensor, alpha: float) -> Tensor:
    """Mean of 1/2 (log Z + alpha (log p_post - log p_prior) - r)^2 over chains (n,)."""
    return 0.5 * (log_z + alpha * ratio - reward.detach()).square().mean()


def _sum(first: Predict, second: Predict, x: Tensor, t: Tensor) -> Tensor:
    return first(x, t) + second(x, t)


def _step(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    optimizer.step()


class DiBO(Baseline):
    """Diffusion-based Bayesian optimization.  It is slow: minutes a round on a CPU.

    popsize: points a round, 50.
    initial: uniform points before the first round.
    buffer: best points that are remembered.
    proxy_epochs, prior_epochs: passes over the buffer; posterior_epochs: steps of Adam.
    search_epochs: steps of Adam on each sample.
    proposals: M; M times popsize M samples compete for the popsize places of a round.
    diffusion_steps, alpha, gamma: see above.
    width, proxy_width: of the diffusion networks and of the ensemble's.
    batch: examples, or chains, a training step.
    precision: "double" or "single".

    The other options are those of `Baseline`; `sigma0` is not used.  The defaults are those of
    the FIDE paper, which took them from the authors'.  Raises OptionError.
    """

    name: ClassVar[str] = "dibo"
    more_options = tuple(option.name for option in fields(RoundOptions))

    def __init__(
        self,
        dim: int,
        target: object = None,
        *,
        initial: int = 100,
        buffer: int = 300,
        precision: str = "double",
        **options: Any,
    ) -> None:
        of_rounds = {name: options.pop(name) for name in self.more_options if name in options}
        super().__init__(dim, target, **options)
        self.initial = whole_number("initial", initial, 2)
        self.buffer = whole_number("buffer", buffer, 2)
        self.precision = one_of("double", "single")("precision", precision)
        self.round_options = RoundOptions(**of_rounds)
        self._rng = np.random.default_rng(self.seed)
        self._generator = torch.Generator().manual_seed(int(self._rng.integers(2**63)))
        self._points: Float64 = np.empty((0, self.dim))  # the buffer
        self._values: Float64 = np.empty(0)
        self._waiting: Float64 | None = None  # candidates of this round

    def _sample(self) -> Float64:
        if len(self._values) < min(self.initial, self.buffer):
            X = self._rng.random((self.popsize, self.dim))
            if not len(self._asked):
                X[0] = 0.5
            return X
        if self._waiting is None:
            with timed(self.times, "train"):
                self._waiting = self._propose()
        return self._waiting

    def _update(self, X: Float64, losses: Float64, features: Float32 | None) -> None:
        finite = np.isfinite(losses)
        self._points = np.concatenate([self._points, X[finite]])
        self._values = np.concatenate([self._values, losses[finite]])
        best = np.argsort(self._values, kind="stable")[: self.buffer]
        self._points, self._values = self._points[best], self._values[best]
        if self._waiting is not None:  # if more was asked, they are the same candidates
            self._population.forget_pending()
        self._waiting = None

    @user_threads
    def _propose(self) -> Float64:
        """One round: candidates (popsize, d) from the buffer."""
        dtype = torch.float64 if self.precision == "double" else torch.float32
        x, y = (torch.as_tensor(one, dtype=dtype) for one in (self._points, -self._values))
        mean, std = x.mean(dim=0), x.std(dim=0) + 1e-7
        x, y = (x - mean) / std, (y - y.mean()) / (y.std() + 1e-7)
        proposed: Tensor = Round(self.round_options, x, y, self._generator).candidates(self.popsize)
        candidates: Float64 = (proposed * std + mean).clamp(0.0, 1.0).to(torch.float64).numpy()
        return candidates

    def _default_popsize(self) -> int:
        return 50

    def settings(self) -> dict[str, Any]:
        """Arguments of the constructor, by name, but for `loss` and `device`."""
        return {**super().settings(), **asdict(self.round_options)}
