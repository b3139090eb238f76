"""Drawing one parameter after the other: the same as before in far fewer operations."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from fide_plugins.learning.networks import Autoregressive

WIDTH = 16


def head_of(d: int) -> tuple[Autoregressive, Tensor]:
    """A head of d parameters, every third on a circle, and features (1, width)."""
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(d)
        head = Autoregressive(WIDTH, torch.arange(d) % 3 == 0)
        return head, torch.randn(1, WIDTH)


@torch.no_grad()
def drawn(head: Autoregressive, vector: Tensor, n: int, generator: torch.Generator) -> Tensor:
    return head.sample(torch.empty(1, 0, 0), vector, n, generator)


@torch.no_grad()
def by_the_whole_network(
    head: Autoregressive, vector: Tensor, n: int, generator: torch.Generator
) -> Tensor:
    """Draw (n, d): each step computes all columns and uses one."""
    d = len(head.periodic)
    u = torch.full((n, d), 0.5)
    for i in range(d):
        u[:, i] = head._of(vector.expand(n, -1), u).draw_mixture(generator)[:, i]
    return u


@pytest.mark.parametrize("d", [1, 2, 7, 12])
@pytest.mark.parametrize("scale", [1.0, 1.7])
def test_a_seed_draws_what_the_whole_network_draws(d: int, scale: float) -> None:
    head, vector = head_of(d)
    head.scale = scale
    one, other = torch.Generator().manual_seed(5), torch.Generator().manual_seed(5)
    x, y = drawn(head, vector, 50, one), by_the_whole_network(head, vector, 50, other)
    torch.testing.assert_close(x, y, rtol=0, atol=1e-5)
    assert torch.equal(one.get_state(), other.get_state())  # as many random numbers


def test_drawing_takes_no_more_operations_than_one_density() -> None:
    """So they grow with the square of the parameters, not with the cube."""
    operations = []
    for d in (8, 16, 32):
        head, vector = head_of(d)
        with FlopCounterMode(display=False) as sampling:
            drawn(head, vector, 10, torch.Generator().manual_seed(0))
        with FlopCounterMode(display=False) as density, torch.no_grad():
            head.log_prob(torch.empty(1, 0, 0), vector.expand(10, -1), torch.full((10, d), 0.5))
        assert 0 < sampling.get_total_flops() <= density.get_total_flops()
        operations.append(sampling.get_total_flops())
    assert operations[2] < 4 * operations[1] < 16 * operations[0]
