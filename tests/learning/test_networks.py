"""Densities of parameters, and exchangeable blocks as a set."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

import fide_tasks
from fide_plugins.errors import OptionError
from fide_plugins.learning import learn
from fide_plugins.learning.judging import matched
from fide_plugins.learning.networks import Autoregressive, Blocks
from fide_plugins.learning.pipeline import blocks_of
from fide_plugins.learning.posterior import _middle
from fide_plugins.learning.renders import as_renderer
from fide_plugins.space import Float, Space

WIDTH = 16


def head_of(d: int) -> tuple[Autoregressive, Tensor]:
    """A head of d parameters, every third on a circle, and features (1, width)."""
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(d)
        head = Autoregressive(WIDTH, torch.arange(d) % 3 == 0)
        return head, torch.randn(1, WIDTH)


@torch.no_grad()
def drawn(
    head: Autoregressive,
    vector: Tensor,
    n: int,
    generator: torch.Generator,
    scale: float = 1.0,
) -> Tensor:
    return head.sample(torch.empty(1, 0, 0), vector, n, generator, scale)


@torch.no_grad()
def by_the_whole_network(
    head: Autoregressive, vector: Tensor, n: int, generator: torch.Generator, scale: float
) -> Tensor:
    """Draw (n, d): each step computes all columns and uses one."""
    d = len(head.periodic)
    u = torch.full((n, d), 0.5)
    for i in range(d):
        u[:, i] = head._of(vector.expand(n, -1), u, scale).draw(generator)[:, i]
    return u


@pytest.mark.parametrize("d", [1, 2, 7, 12])
@pytest.mark.parametrize("scale", [1.0, 1.7])
def test_a_seed_draws_what_the_whole_network_draws(d: int, scale: float) -> None:
    head, vector = head_of(d)
    one, other = torch.Generator().manual_seed(5), torch.Generator().manual_seed(5)
    x = drawn(head, vector, 50, one, scale)
    y = by_the_whole_network(head, vector, 50, other, scale)
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
            head.log_prob(
                torch.empty(1, 0, 0), vector.expand(10, -1), torch.full((10, d), 0.5), 1.0
            )
        assert 0 < sampling.get_total_flops() <= density.get_total_flops()
        operations.append(sampling.get_total_flops())
    assert operations[2] < 4 * operations[1] < 16 * operations[0]


@pytest.mark.slow
def test_cells_are_found_in_any_order() -> None:
    task = fide_tasks.make("voronoi", 16, cells=2)
    model = learn(task, renders=2000, size=16, passes=4)
    assert len(model.blocks) == 2
    assert model.report.nll < -1
    x = task.x_star
    assert x is not None
    swapped = np.roll(x, 5)
    p, q = model.log_prob(task.target, [x, swapped])
    np.testing.assert_allclose(p, q, rtol=1e-5)
    np.testing.assert_array_equal(matched(swapped, x, model.network.periodic, model.blocks), x)


def test_where_something_is_counts_from_the_first_step() -> None:
    """Also beside features that are large, as those of an encoder become."""
    spread = []
    for seed in range(4):
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)
            encoder: Any = SimpleNamespace(channels=16, grid=(4, 6))
            head = Blocks(encoder, 8, torch.zeros(4, dtype=torch.bool), [[0, 1], [2, 3]])
            plain, thing = 1000 * torch.randn(2, 16)
        images = plain.repeat(24, 24, 1)  # (B, places, channels)
        images[range(24), range(24)] = thing  # in each image at another place
        with torch.no_grad():
            said = head.log_prob(images, torch.zeros(24, 8), torch.full((24, 4), 0.5), 1.0)
        spread.append(float(said.std()))
    assert np.median(spread) > 1e-3


def test_the_middle_of_sets_goes_around_circles() -> None:
    rng = np.random.default_rng(0)
    truth = np.array([0.999, 0.3, 0.002, 0.98])
    periodic = np.array([True, False, True, False])
    x = truth + 0.05 * rng.standard_normal((2000, 4))
    x = np.where(periodic, np.mod(x, 1.0), np.clip(x, 0.0, 1.0))
    apart = np.abs(_middle(x, periodic) - truth)
    assert np.where(periodic, np.minimum(apart, 1 - apart), apart).max() < 0.01


def test_blocks_of_different_kinds_are_refused() -> None:
    """A straight axis would be learned as one that wraps around."""
    space = Space(a=Float(0, 1), b=Float(0, 360, periodic=True), c=Float(0, 1), d=Float(0, 1))
    for groups in ([[0, 1], [2, 3]], [[2, 3], [0, 1]]):
        with pytest.raises(OptionError, match=r"groups must be alike: of \[(1, 3|3, 1)\], which"):
            learn(lambda params: np.zeros((16, 16)), space, groups=groups, renders=100)
    alike = Space(a=Float(0, 1), b=Float(0, 360, periodic=True), c=Float(0, 360, periodic=True))
    assert blocks_of(as_renderer(len, alike), [[1], [2]]) == [[1], [2]]
