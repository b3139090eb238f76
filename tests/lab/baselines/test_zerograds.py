"""ZeroGrads: the network, one step by hand, and what it minimizes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from fide_lab.baselines.zerograds import Proxy, ZeroGrads, make
from fide_plugins.errors import OptionError
from fide_plugins.types import Float64


def valley(X: Float64) -> Float64:
    value: Float64 = ((X - 0.8) ** 2).sum(axis=1)
    return value


def proxy(dim: int) -> Proxy:
    return make(lambda: Proxy(dim), torch.Generator().manual_seed(0))


def test_the_network_has_three_hidden_layers_of_64() -> None:
    shapes = [tuple(p.shape) for p in proxy(5).parameters()]
    assert shapes == [(64, 5), (64,), (64, 64), (64,), (64, 64), (64,), (1, 64), (1,)]
    assert proxy(5)(torch.zeros(7, 5)).shape == (7,)


def test_its_gradient_is_that_of_finite_differences() -> None:
    network = proxy(3).double()
    x, h = torch.tensor([0.2, 0.7, 0.4], dtype=torch.float64), 1e-6
    differences = [
        (network((x + h * e)[None]) - network((x - h * e)[None])) / (2 * h)
        for e in torch.eye(3, dtype=torch.float64)
    ]
    torch.testing.assert_close(network.gradient(x), torch.cat(differences).detach())


def test_a_step_by_hand() -> None:
    opt = ZeroGrads(3, seed=4, popsize=7, learning_rate=0.01, proxy_rate=3e-3)
    network = make(lambda: Proxy(3), torch.Generator())
    network.load_state_dict(opt._proxy.state_dict())
    theta = torch.full((3,), 0.5)
    of_theta = torch.optim.Adam([theta], lr=0.01)
    of_network = torch.optim.Adam(network.parameters(), lr=3e-3)
    scale = None
    for _ in range(4):
        X = opt.ask()
        losses = valley(X)
        np.testing.assert_array_equal(X[-1], theta.numpy().astype(np.float64))
        seen = np.array([opt._unshifted[x.tobytes()] for x in X[:6]])
        np.testing.assert_allclose(seen[:3] + seen[3:], 2 * X[[-1] * 3], atol=1e-12)  # antithetic
        opt.tell(X, losses=losses)
        for _ in range(3):
            theta.grad = network.gradient(theta)
            of_theta.step()
        scale = losses[:6].mean() if scale is None else scale
        for _ in range(3):
            of_network.zero_grad()
            predicted = network(torch.tensor(seen, dtype=torch.float32))
            error = predicted - torch.tensor(losses[:6] / scale, dtype=torch.float32)
            error.square().mean().backward()
            of_network.step()
    np.testing.assert_allclose(opt.recommend(), theta.numpy(), rtol=1e-6)


def test_smoothing_moves_what_is_rendered_and_not_what_is_learned() -> None:
    opt = ZeroGrads(50, seed=0, popsize=81, sigma0=0.05)
    X = opt.ask()
    learned = np.array([opt._unshifted[x.tobytes()] for x in X[:80]])
    np.testing.assert_allclose(learned[:40] + learned[40:], 1.0, atol=1e-12)
    np.testing.assert_allclose((X[:80] - learned).std(), 0.005, rtol=0.05)
    np.testing.assert_allclose(learned.std(), 0.05, rtol=0.05)


@pytest.mark.parametrize(
    "options",
    [
        {"learning_rate": 0.0},
        {"proxy_rate": -1.0},
        {"popsize": 2},
        {"popsize": 20.5},
    ],
    ids=str,
)
def test_options_out_of_range_are_named(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=next(iter(options))):
        ZeroGrads(2, **options)


@pytest.mark.parametrize(("popsize", "taken"), [(3, 3), (4, 3), (20, 19), (21, 21)])
def test_the_population_is_odd(popsize: int, taken: int) -> None:
    opt = ZeroGrads(3, popsize=popsize, seed=0)
    assert opt.popsize == len(opt.ask()) == taken
