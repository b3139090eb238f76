"""Batches of one size: how large they are, and that nobody sees what fills them up."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from fide_plugins.runtime.devices import batch_size, in_batches


@pytest.mark.parametrize(
    ("side", "on_cpu", "on_gpu"),
    [(512, 1, 6), (224, 1, 32), (112, 2, 128), (80, 3, 250), (64, 4, 256), (16, 4, 256)],
)
def test_a_single_image_pays_for_few(side: int, on_cpu: int, on_gpu: int) -> None:
    assert batch_size(torch.device("cpu"), side, side) == on_cpu
    assert batch_size(torch.device("cuda"), side, side) == on_gpu


@pytest.mark.parametrize("n", [0, 1, 3, 4, 7])
def test_the_network_sees_one_size(n: int) -> None:
    seen: list[int] = []

    def network(x: Tensor) -> Tensor:
        seen.append(len(x))
        return x.sum(dim=1) + 1

    images = torch.arange(2.0 * n).reshape(n, 2)
    assert torch.equal(in_batches(network, images, 3), images.sum(dim=1) + 1)
    assert seen == [3] * max(-(-n // 3), 1)
