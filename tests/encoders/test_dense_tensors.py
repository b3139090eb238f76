"""The path of tensors gives what OpenCV gives, to 1e-5."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
import torch

from fide_plugins import encoders
from fide_plugins.encoders.bilateral import bilateral
from fide_plugins.encoders.dense import NOISY
from fide_plugins.encoders.despeckle import despeckled, despeckled_planes
from fide_plugins.encoders.noise_level import noise_level, noise_levels

SIZES = [(1, 1), (2, 3), (7, 5), (84, 84), (112, 112), (113, 90), (1, 7100), (7100, 1), (16, 512)]


def smooth(rng: Any, height: int, width: int, noise: float) -> Any:
    rows, columns = np.mgrid[:height, :width]
    waves = [np.sin(columns / 9), np.cos(rows / 7), np.sin((rows + columns) / 11)]
    image = 0.5 + 0.4 * np.stack(waves, -1) + noise * rng.standard_normal((height, width, 3))
    return image.clip(0, 1)


KINDS: dict[str, Any] = {
    "random": lambda rng, height, width: rng.random((height, width, 3)),
    "constant": lambda rng, height, width: np.broadcast_to(rng.random(3), (height, width, 3)),
    "black and white": lambda rng, height, width: rng.integers(0, 2, (height, width, 3)),
    "no noise": lambda rng, height, width: smooth(rng, height, width, 0),
    "noise": lambda rng, height, width: smooth(rng, height, width, NOISY / 2),
}
every_kind = pytest.mark.parametrize("kind", KINDS)
every_size = pytest.mark.parametrize("size", SIZES)


def images(kind: str, size: tuple[int, int]) -> Any:
    rng = np.random.default_rng(size)
    return np.stack([KINDS[kind](rng, *size) for _ in range(3)]).astype(np.float32)


def planes(batch: Any) -> torch.Tensor:
    return torch.from_numpy(batch).permute(0, 3, 1, 2)


@every_kind
@every_size
def test_tokens(kind: str, size: tuple[int, int]) -> None:
    batch = images(kind, size)
    encoder = encoders.make("dense")
    tokens = encoder.compute_tensor(torch.from_numpy(batch))
    torch.testing.assert_close(tokens, encoder(batch), atol=1e-5, rtol=0)
    assert encoder.compute_tensor(torch.from_numpy(batch[:0])).shape == (0, *tokens.shape[1:])
    alone = encoder.compute_tensor(torch.from_numpy(batch[1:2]))  # its place may change a digit
    torch.testing.assert_close(alone[0], tokens[1], atol=1e-6, rtol=0)


@every_kind
@every_size
def test_medians_are_equal(kind: str, size: tuple[int, int]) -> None:
    batch = images(kind, size)
    expected = np.stack([despeckled(image) for image in batch])
    found = despeckled_planes(planes(batch)).permute(0, 2, 3, 1)
    np.testing.assert_array_equal(found.numpy(), expected)


@every_kind
@every_size
def test_levels_of_noise_are_equal(kind: str, size: tuple[int, int]) -> None:
    batch = images(kind, size)
    clean = np.stack([despeckled(image) for image in batch])
    expected = [noise_level(*pair) for pair in zip(batch, clean, strict=True)]
    assert noise_levels(planes(batch), planes(clean)).tolist() == expected


@every_kind
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (2, 2), (3, 30), (28, 28), (33, 20)])
@pytest.mark.parametrize(("diameter", "tones"), [(7, 0.5), (3, 0.1)])
def test_bilateral(kind: str, size: tuple[int, int], diameter: int, tones: float) -> None:
    batch = images(kind, size)
    filtered = [cv2.bilateralFilter(image, diameter, tones, diameter / 2) for image in batch]
    found = bilateral(planes(batch), diameter, tones, diameter / 2).permute(0, 2, 3, 1)
    np.testing.assert_allclose(found, np.reshape(filtered, batch.shape), atol=1e-5)
