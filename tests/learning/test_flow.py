"""The density of a flow: its integral, its samples, both ends of a circle."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from fide_plugins.learning.flow import Flow

pytestmark = pytest.mark.filterwarnings(
    "ignore:.torch.jit.script. is deprecated"
)  # PyTorch's own use

_SIDE = 60
MIDDLES = (torch.arange(_SIDE) + 0.5) / _SIDE


def truths(n: int, generator: torch.Generator) -> Tensor:
    """Draw (n, 2): two modes on the first axis, one around the ends of the second."""
    noise = torch.randn((n, 2), generator=generator)
    which = torch.randint(2, (n,), generator=generator)
    first = 0.3 + 0.4 * which + 0.05 * noise[:, 0]
    return torch.stack([first.clamp(0.01, 0.99), (0.08 * noise[:, 1]) % 1.0], dim=1)


@pytest.fixture(scope="module")
def head() -> Flow:
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(0)
        head = Flow(2, torch.tensor([False, True]))
    generator = torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(head.parameters(), lr=2e-3)
    for step in range(600):
        optimizer.param_groups[0]["lr"] = 2e-3 * (1 - step / 600)
        optimizer.zero_grad()
        loss = head.loss(torch.zeros(0), torch.ones(64, 2), truths(64, generator), generator)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    return head


def density(head: Flow) -> Tensor:
    """Of the middles of the cells of a grid, (60, 60)."""
    with torch.no_grad():
        u = torch.cartesian_prod(MIDDLES, MIDDLES)
        return head.log_prob(torch.zeros(0), torch.ones(len(u), 2), u).exp().view(_SIDE, _SIDE)


def test_the_density_integrates_to_one_and_agrees_with_samples(head: Flow) -> None:
    p = density(head)
    assert 0.97 < p.mean() < 1.03
    with torch.no_grad():
        drawn = head.sample(
            torch.zeros(0), torch.ones(1, 2), 20_000, torch.Generator().manual_seed(1)
        )
    cells = (drawn * 6).long().clamp(max=5)
    share = torch.bincount(cells[:, 0] * 6 + cells[:, 1], minlength=36) / len(drawn)
    expected = p.view(6, 10, 6, 10).mean(dim=(1, 3)).flatten() / 36
    assert (share - expected).abs().max() < 0.02


def test_both_modes_and_both_ends_of_the_circle_are_there(head: Flow) -> None:
    p = density(head)
    first, second = p.mean(dim=1), p.mean(dim=0)
    assert first[18] > 3 * first[30] and first[42] > 3 * first[30]
    torch.testing.assert_close(second[0], second[-1], rtol=0.2, atol=0.0)
    assert second[0] > 5 * second[30]
