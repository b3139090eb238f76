"""One round of DiBO: networks fitted to the buffer, and candidates drawn from them."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property, partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from fide_lab.baselines.dibo.diffusion import (
    Diffusion,
    Predict,
    draw_normal,
    paper_betas,
    program_betas,
)
from fide_lab.baselines.dibo.likelihood import program_likelihood
from fide_lab.baselines.dibo.networks import Ensemble, NoisePredictor
from fide_lab.baselines.networks import make
from fide_plugins.validation.options import Rule, one_of, positive, whole

__all__ = ["Round", "RoundOptions", "trajectory_balance"]

JITTER = 1e-3  # noise on training points
POOL_JITTER = 1e-2  # noise on points of the pool
RATE, POSTERIOR_RATE, SEARCH_RATE = 1e-3, 1e-4, 1e-2  # of Adam


def _option(rule: Rule) -> Any:
    return field(metadata={"rule": rule})


@dataclass(frozen=True)
class RoundOptions:
    """What `DiBO` documents; the defaults are those of its constructor."""

    proxy_epochs: int = _option(whole(1))
    prior_epochs: int = _option(whole(1))
    posterior_epochs: int = _option(whole(0))
    search_epochs: int = _option(whole(0))
    proposals: int = _option(whole(1))
    diffusion_steps: int = _option(whole(2))
    alpha: float = _option(positive)
    gamma: float = _option(positive)
    width: int = _option(whole(1))
    proxy_width: int = _option(whole(1))
    batch: int = _option(whole(1))
    likelihood: str = _option(one_of("authors", "exact"))
    schedule: str = _option(one_of("authors", "paper"))

    @classmethod
    def checked(cls, **given: Any) -> RoundOptions:
        """Options, each checked by its rule; OptionError (a ValueError) if one breaks it."""
        rules = {option.name: option.metadata["rule"] for option in fields(cls)}
        return cls(**{name: rules[name](name, value) for name, value in given.items()})

    def as_dict(self) -> dict[str, Any]:
        """All of them, by name."""
        return asdict(self)


class Round:
    """Networks fitted to standardized points x (n, d) and values y (n,), the higher the better."""

    def __init__(
        self, options: RoundOptions, x: Tensor, y: Tensor, generator: torch.Generator
    ) -> None:
        self.options, self.x, self.y, self.generator = options, x, y, generator
        betas = program_betas if options.schedule == "authors" else paper_betas
        steps = options.diffusion_steps
        self.diffusion = Diffusion(steps, x.dtype, x.device, betas(steps))

    @cached_property
    def proxy(self) -> Ensemble:
        """The reward, (n, d) -> (n,)."""
        o = self.options
        ensemble: Ensemble = self._make(lambda: Ensemble(self.x.shape[1], o.proxy_width, o.gamma))
        for member in ensemble.members:
            adam = torch.optim.Adam(member.parameters(), lr=RATE)
            for x, y in self._batches(o.proxy_epochs):
                _step(adam, F.mse_loss(member(x)[:, 0], y))
        ensemble.requires_grad_(False)
        return ensemble

    @cached_property
    def prior(self) -> NoisePredictor:
        """The diffusion model of the buffer."""
        network: NoisePredictor = self._make(
            lambda: NoisePredictor(self.x.shape[1], self.options.width)
        )
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
            noise = draw_normal(
                self.x.new_empty(n * self.options.proposals, self.x.shape[1]), self.generator
            )
            several.append(
                self._improved(self.diffusion.denoise(posterior, noise, self.generator)[-1])
            )
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
        if self.options.likelihood == "authors":
            likelihood = program_likelihood(self.prior, x, self.options.diffusion_steps, generator)
        else:
            likelihood = self.diffusion.log_likelihood(self.prior, x, generator)
        score: Tensor = self.proxy(x) + self.options.alpha * likelihood
        return score

    def _chains(self, predict: Predict, pool: Tensor, rewards: Tensor) -> Tensor:
        """States (T + 1, batch, d): with equal chance its own, or noised points of the pool."""
        batch = self.options.batch
        own = int(torch.randint(2, (), generator=self.generator)) == 0
        if own:
            noise = draw_normal(self.x.new_empty(batch, self.x.shape[1]), self.generator)
            return self.diffusion.denoise(predict, noise, self.generator)
        chosen = rewards.softmax(0).multinomial(batch, True, generator=self.generator)
        x = pool[chosen]
        return self.diffusion.noise(
            x + POOL_JITTER * draw_normal(x, self.generator), self.generator
        )

    def _batches(self, epochs: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Training points, drawn with weights exp(y), as many an epoch as the buffer holds."""
        weights = self.y.exp()
        for _ in range(epochs):
            order = weights.multinomial(len(self.y), True, generator=self.generator)
            for chosen in torch.split(order, self.options.batch):
                x = self.x[chosen]
                yield x + JITTER * draw_normal(x, self.generator), self.y[chosen]

    def _make(self, build: Any) -> Any:
        return make(build, self.generator, self.x.dtype, self.x.device)


def trajectory_balance(log_z: Tensor, ratio: Tensor, reward: Tensor, alpha: float) -> Tensor:
    """Mean of 1/2 (log Z + alpha (log p_post - log p_prior) - r)^2 over chains (n,)."""
    return 0.5 * (log_z + alpha * ratio - reward.detach()).square().mean()


def _sum(first: Predict, second: Predict, x: Tensor, t: Tensor) -> Tensor:
    return first(x, t) + second(x, t)


def _step(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    optimizer.step()
