"""Objectives against closed forms, and the passes of `fit`."""

from __future__ import annotations

from typing import Any, cast

import pytest
import torch
from torch import Tensor, nn

from fide_lab.baselines.image_based import WhitenedLoss, whitened
from fide_plugins.denoiser.network import Context
from fide_plugins.denoiser.training import adam_state, fit, load_adam_state, x_loss, x_prediction

STD = torch.tensor([0.3, 0.1, 0.7])


def gaussian(n: int) -> Tensor:
    return 0.5 + STD * torch.randn(n, 3, generator=torch.Generator().manual_seed(0))


def test_published_loss_tells_the_noise_of_each_parameter() -> None:
    def perfect(z: Tensor, s: Tensor) -> Tensor:
        times = s / STD
        torch.testing.assert_close(times, times[:, :1].expand_as(times))  # one time an example
        assert 0 <= float(times.min()) < 0.1
        assert 0.9 < float(times.max()) <= 1
        return gaussian(500)

    assert float(x_loss(perfect, gaussian(500), STD, torch.Generator())) == 0


@pytest.mark.parametrize("log_mean", [-3.0, 0.0, 3.0])
def test_whitened_loss_of_nothing_is_one_at_every_noise(log_mean: float) -> None:
    """Of Gaussian data `whitened` needs no network, and what is left has variance 1."""
    denoise = whitened(lambda z, s: torch.zeros_like(z), 0.5, STD)
    objective = WhitenedLoss(log_mean, 0.3)
    loss = objective(denoise, gaussian(100_000), STD, torch.Generator().manual_seed(1))
    assert float(loss) == pytest.approx(1, rel=0.03)


class Line(nn.Module):
    """x_hat = a * z + b * image; counts what it sees."""

    def __init__(self) -> None:
        super().__init__()
        self.weights = nn.Parameter(torch.zeros(2))
        self.seen: list[Tensor] = []

    def encode_context(self, tokens: Tensor) -> Context:
        self.seen.append(tokens[:, 0, 0])
        return [(tokens, tokens)]

    def forward(self, z: Tensor, s: Tensor, context: Context) -> Tensor:
        return self.weights[0] * z + self.weights[1] * context[0][0][:, 0]


def train(epochs: int, batch_size: int, seed: int = 0, lr: float = 0.05) -> tuple[Line, Tensor]:
    x = gaussian(50)
    line = Line()
    losses = fit(
        cast(Any, line),  # what `fit` uses of a network
        x_prediction,
        x_loss,
        torch.optim.Adam(line.parameters(), lr=lr),
        x,
        (x - 0.5)[:, None],
        STD,
        epochs=epochs,
        batch_size=batch_size,
        generator=torch.Generator().manual_seed(seed),
    )
    return line, losses


def test_every_pair_is_seen_once_an_epoch_in_a_new_order() -> None:
    line, losses = train(epochs=3, batch_size=20)
    assert [len(batch) for batch in line.seen] == [20, 20, 10] * 3
    epochs = [torch.cat(line.seen[3 * i : 3 * i + 3]) for i in range(3)]
    for epoch in epochs:
        assert torch.equal(epoch.sort().values, epochs[0].sort().values)
    assert not torch.equal(epochs[0], epochs[1])
    assert losses.shape == (3,)


def test_loss_of_an_epoch_is_the_mean_over_its_pairs() -> None:
    """With steps too small to matter, and no image yet: E[x_hat - x]^2 with x_hat = 1/2."""
    _, losses = train(epochs=1, batch_size=20, lr=1e-12)
    assert float(losses[0]) == pytest.approx(float((gaussian(50) - 0.5).square().mean()), rel=1e-5)


def test_adam_continues_bit_for_bit() -> None:
    def step(optimizer: torch.optim.Optimizer, weight: Tensor) -> None:
        weight.grad = weight.detach().sin()
        optimizer.step()

    first = torch.ones(4, requires_grad=True)
    optimizer = torch.optim.Adam([first], lr=0.1)
    step(optimizer, first)
    second = first.detach().clone().requires_grad_()
    copy = torch.optim.Adam([second], lr=0.1)
    saved = {
        number: {name: value.numpy() for name, value in entry.items()}
        for number, entry in adam_state(optimizer).items()
    }
    load_adam_state(copy, saved)
    for _ in range(3):
        step(optimizer, first)
        step(copy, second)
    assert torch.equal(first, second)
