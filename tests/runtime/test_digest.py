"""Other weights, names of weights or settings have another digest."""

from __future__ import annotations

import torch
from torch import nn

from fide_plugins.runtime.devices import digest


def network(second: float = 1.0) -> nn.Module:
    """A network of two numbers."""
    made = nn.Linear(2, 1, bias=False)
    made.weight.data = torch.tensor([[1.0, second]])
    return made


def test_it_is_of_names_and_values() -> None:
    first = digest(network())
    assert len(first) == 8 and digest(network()) == first
    assert digest(network(1.0000001)) != first
    assert digest(nn.Sequential(network())) != first  # "0.weight"


def test_it_may_be_of_more() -> None:
    one, other = network(), network(0.0)
    made = [digest(one), digest(one, other), digest(other, one)]
    made += [digest(one, extra=[1.0]), digest(one, extra=[2.0])]
    assert len(set(made)) == 5
