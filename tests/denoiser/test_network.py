"""The transformer of supplement S1: shapes, seeds, gradients, and the shared image context."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from fide_plugins.denoiser.network import ParameterTransformer
from fide_plugins.errors import OptionError


def make(dim: int = 5, seed: int = 0, **sizes: int) -> ParameterTransformer:
    generator = torch.Generator().manual_seed(seed)
    return ParameterTransformer(dim, 6, 7, generator=generator, **({"width": 16} | sizes))


def example(n: int, dim: int = 5, seed: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """Parameters z (n, dim), noise s (n, dim), tokens (n, 6, 7)."""
    g = torch.Generator().manual_seed(seed)
    s = torch.rand(n, dim, generator=g)
    return torch.randn(n, dim, generator=g), s, torch.randn(n, 6, 7, generator=g)


@pytest.mark.parametrize("dim", [1, 2, 512])
def test_any_number_of_parameters(dim: int) -> None:
    network = make(dim, width=4, heads=2)
    z, s, tokens = example(3, dim)
    out = network(z, s, network.encode_context(tokens))
    assert out.shape == (3, dim)
    assert bool(out.isfinite().all())


def test_examples_of_a_batch_do_not_see_each_other() -> None:
    network = make()
    z, s, tokens = example(8)
    order = torch.tensor([3, 1, 7, 0, 2, 6, 5, 4])
    out = network(z, s, network.encode_context(tokens))
    permuted = network(z[order], s[order], network.encode_context(tokens[order]))
    torch.testing.assert_close(permuted, out[order])


def test_gradient_reaches_every_weight_at_the_start() -> None:
    network = make()
    z, s, tokens = example(16)
    network(z, s, network.encode_context(tokens)).square().sum().backward()
    without = [
        name
        for name, weight in network.named_parameters()
        if weight.grad is None or not bool(weight.grad.any())
    ]
    assert without == []


def test_seed_decides_the_weights_and_global_state_is_untouched() -> None:
    torch.manual_seed(5)
    before = torch.get_rng_state()
    first, second, other = make(seed=3), make(seed=3), make(seed=4)
    assert torch.equal(before, torch.get_rng_state())
    for name, weight in first.state_dict().items():
        assert torch.equal(weight, second.state_dict()[name]), name
        assert not torch.equal(weight, other.state_dict()[name]), name


@pytest.mark.parametrize("sizes", [{"dim": 0}, {"width": 0}, {"heads": 3}, {"blocks": 0}])
def test_impossible_sizes(sizes: dict[str, int]) -> None:
    with pytest.raises(OptionError, match=next(iter(sizes))):
        make(**sizes)
