"""The published proposer on a GPU: what it computes there is what a processor computes.

A GPU may add in another order every time, so a run is compared with a tolerance; what is said to be
the same in two ways of one run, with a larger one than rounding alone would need.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from fide_plugins.fide import FIDE
from fide_plugins.proposers.diffusion import DiffusionProposer
from fide_plugins.types import Float64

pytestmark = pytest.mark.gpu

DIM = 6
STD = np.full(DIM, 0.1)


def make(device: str, **options: Any) -> DiffusionProposer:
    return DiffusionProposer(DIM, seed=3, device=device, epochs=4, batch_size=20, **options)


def scene(device: str) -> tuple[Float64, torch.Tensor]:
    """Parameters (40, d) and "images" (40, d, 1) that show them."""
    x = 0.5 + STD * np.random.default_rng(0).standard_normal((40, DIM))
    return x, torch.as_tensor(x[:, :, None], dtype=torch.float32, device=device)


def propose(proposer: DiffusionProposer, device: str) -> Float64:
    x, tokens = scene(device)
    rng = np.random.default_rng(0)
    return proposer.propose(x, tokens[0], np.full(DIM, 0.5), STD, rng)


def learned(device: str, **options: Any) -> DiffusionProposer:
    proposer = make(device, **options)
    x, tokens = scene(device)
    for _ in range(2):
        proposer.update(x, tokens, None, STD)
    return proposer


def test_before_training_as_on_the_processor() -> None:
    """The initial weights are the same, and so is what the network makes of them."""
    there, here = (propose(make(device), device) for device in ("cuda", "cpu"))
    np.testing.assert_allclose(there, here, atol=1e-4)


def test_a_step_of_training_as_on_the_processor() -> None:
    """Of the processor's weights, with the same noise: generators differ from device to device."""

    def noiseless(denoise: Any, x: torch.Tensor, std: torch.Tensor, generator: Any) -> torch.Tensor:
        return torch.mean((denoise(x, (0.5 * std).expand_as(x)) - x) ** 2)

    weights = []
    for device in ("cuda", "cpu"):
        proposer = DiffusionProposer(
            DIM, seed=3, device=device, epochs=1, batch_size=40, objective=noiseless
        )
        x, tokens = scene(device)
        proposer.update(x, tokens, None, STD)
        assert {w.device.type for w in proposer._parts(DIM, 1)[0].parameters()} == {device}
        weights.append(proposer.state_dict()["adam"])
    for number, entry in weights[1].items():
        there = weights[0][number]["exp_avg"]
        largest = float(entry["exp_avg"].abs().max())
        torch.testing.assert_close(there, entry["exp_avg"], atol=1e-2 * largest + 1e-7, rtol=0)


def test_it_learns_there() -> None:
    proposer = make("cuda")
    x, tokens = scene("cuda")
    first = proposer.update(x, tokens, None, STD)[0]
    for _ in range(5):
        last = proposer.update(x, tokens, None, STD)[-1]
    assert float(last) < 0.5 * float(first)
    assert not (propose(proposer, "cuda") == x).any()  # samples that the network gave no number for


def test_goes_on_where_it_was_saved() -> None:
    original, copy = learned("cuda"), make("cuda")
    copy.load_state_dict(original.state_dict())
    np.testing.assert_array_equal(propose(copy, "cuda"), propose(original, "cuda"))
    x, tokens = scene("cuda")
    histories = [each.update(x, tokens, None, STD) for each in (original, copy)]
    torch.testing.assert_close(*histories, rtol=1e-3, atol=0)


def test_the_published_method_gives_the_same_candidates_every_time_there() -> None:
    runs = []
    for _ in range(2):
        opt = FIDE(DIM, np.zeros((32, 32, 3)), preset="paper", popsize=20, epochs=2, seed=0)
        asked = []
        for _ in range(4):
            asked.append(opt.ask())
            images = np.broadcast_to(asked[-1][:, None, None, :3], (20, 32, 32, 3))
            opt.tell(asked[-1], images.astype(np.float32))
        runs.append(asked)
    np.testing.assert_array_equal(runs[0], runs[1])


def test_the_published_method_computes_there_all_alone() -> None:
    """By the device that it takes where there is one."""
    opt = FIDE(DIM, np.zeros((32, 32, 3), np.float32), preset="paper", popsize=8, epochs=1, seed=0)
    proposer: Any = opt.state.proposer
    assert opt.encoder.device.type == proposer._proposer.device.type == "cuda"
    for _ in range(3):
        X = opt.ask()
        opt.tell(X, np.broadcast_to(X[:, None, None, :3], (8, 32, 32, 3)).astype(np.float32))
    assert proposer.state_dict()["updates"] == 3  # when it has learned from the last generation
