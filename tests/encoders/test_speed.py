"""How long encoders and the loss `perceptual` take, in time of the processor.

The table is in tests/README.md.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

from fide_plugins import encoders, losses
from fide_plugins.encoders.pretrained.network import IMAGENET_MEAN, IMAGENET_STD
from fide_plugins.types import Float32

pytestmark = pytest.mark.slow

RNG = np.random.default_rng(16)


@contextmanager
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def seconds(encode: Callable[[Float32], object], images: Float32) -> float:
    """The least of three goes, each with images that no cache has seen."""
    goes = []
    for go in range(3):
        fresh = images * np.float32(1 - go / 1000)
        start = time.process_time()
        encode(fresh)
        goes.append(time.process_time() - start)
    return min(goes)


@pytest.mark.parametrize(("side", "n", "limit"), [(112, 500, 0.25), (224, 500, 0.6)])
def test_dense(side: int, n: int, limit: float) -> None:
    images = RNG.random((n, side, side, 3), dtype=np.float32)
    with one_thread():
        assert seconds(encoders.make("dense"), images) < limit


def test_perceptual() -> None:
    """Half a millisecond an image, on one core that nobody else uses, and a fifth for others."""
    images = RNG.random((500, 112, 112, 3), dtype=np.float32)
    loss = losses.make("perceptual", images[0])
    with one_thread():
        assert seconds(loss.compute, images) < 1.2 * 0.25


def test_dinov3_adds_little_to_its_network(tmp_path: Path) -> None:
    """The small DINOv3 with random weights, 16 images of 224 x 224, and transformers alone."""
    transformers = pytest.importorskip("transformers")
    transformers.utils.logging.disable_progress_bar()
    with torch.random.fork_rng(devices=[]):
        network = transformers.DINOv3ViTModel(transformers.DINOv3ViTConfig()).eval()
    network.save_pretrained(tmp_path)
    colors = {"image_mean": IMAGENET_MEAN, "image_std": IMAGENET_STD}
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(colors))
    encoder = encoders.make(f"dinov3:{tmp_path}")
    images = RNG.random((16, 224, 224, 3), dtype=np.float32)

    @torch.inference_mode()
    def bare(images: Float32) -> None:
        network(torch.from_numpy(images).permute(0, 3, 1, 2).contiguous())

    with one_thread():
        assert seconds(encoder, images) < 1.3 * seconds(bare, images)
