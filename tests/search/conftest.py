"""Synthetic renderers whose structure is known: exchangeable blocks, a painted one, a chain."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fide_plugins.population import TrainingSample
from fide_plugins.types import Float64

TOKENS = 16


def additive(x: Float64, blocks: np.ndarray) -> Float64:
    """Sum of soft bumps on a line, one a block: place and brightness (and more) of each; (16,)."""
    where = (np.arange(TOKENS) + 0.5) / TOKENS
    image = np.zeros(TOKENS)
    for block in blocks:
        place, *rest = x[block]
        image += (0.2 + np.dot(rest, 1.0 + np.arange(len(rest)))) * np.exp(
            -(((where - place) / 0.08) ** 2)
        )
    return image


def brightest(x: Float64, blocks: np.ndarray) -> Float64:
    """The same, but two in one place look like one; (16,)."""
    every = [additive(x, block[None]) for block in blocks]
    image: Float64 = np.max(every, axis=0)
    return image


def painted(x: Float64, blocks: np.ndarray) -> Float64:
    """Opaque intervals, painted in the order of the blocks: place and brightness; (16,)."""
    where = (np.arange(TOKENS) + 0.5) / TOKENS
    image = np.zeros(TOKENS)
    for block in blocks:
        place, *rest = x[block]
        image = np.where(
            np.abs(where - place) < 0.15, 0.2 + np.dot(rest, 1.0 + np.arange(len(rest))), image
        )
    return image


def sample(image: Float64, x: Float64, loss: float = 1.0, index: int = 0) -> TrainingSample:
    """TrainingSample candidate of a gray image (T,), the same in three channels."""
    tokens = torch.as_tensor(np.repeat(image[:, None], 3, axis=1), dtype=torch.float32)
    return TrainingSample(index, x.copy(), tokens, loss, index)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
