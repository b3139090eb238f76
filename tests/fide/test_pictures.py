"""Targets and images of every kind, and what is kept of them."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from fide_plugins.fide import FIDE
from fide_plugins.types import Float32

from .helpers import Render


@pytest.mark.parametrize("kind", ["uint8", "gray", "pil", "path", "tensor"])
def test_kinds_of_targets(kind: str, target: Float32, tmp_path: Path) -> None:
    as_bytes = np.round(target * 255).astype(np.uint8)
    Image.fromarray(as_bytes).save(tmp_path / "target.png")
    given: dict[str, object] = {
        "uint8": as_bytes,
        "gray": target[..., 0],
        "pil": Image.fromarray(as_bytes),
        "path": tmp_path / "target.png",
        "tensor": torch.from_numpy(target).permute(2, 0, 1),
    }
    expected = np.repeat(target[..., :1], 3, -1) if kind == "gray" else target
    opt = FIDE(6, given[kind], seed=0)
    np.testing.assert_allclose(opt.target, expected, atol=0.51 / 255)
    opt.tell(np.full((1, 6), 0.5), opt.target[None])
    assert opt.best is not None and opt.best.loss == 0.0


def test_kinds_of_images_give_the_same_loss(render: Render, target: Float32) -> None:
    X = np.full((2, 6), 0.5)
    as_bytes = np.round(render(X) * 255).astype(np.uint8)
    kinds: list[Any] = [
        as_bytes,
        list(as_bytes),
        as_bytes / 255.0,
        torch.from_numpy(as_bytes),
        [Image.fromarray(image) for image in as_bytes],
    ]
    found = []
    for images in kinds:
        opt = FIDE(6, target, seed=0)
        opt.tell(X, images)
        assert opt.best is not None
        found.append(opt.best.loss)
    np.testing.assert_allclose(found, found[0], rtol=1e-6)


def test_a_batch_of_images_is_not_kept(render: Render, target: Float32) -> None:
    opt = FIDE(6, target, seed=0)
    X = opt.ask()
    images = render(X)
    gone = weakref.ref(images)
    opt.tell(X, images)
    best = opt.best
    assert best is not None and best.image is not None
    assert not np.shares_memory(best.image, images)
    assert best.image.base is None
    del images
    gc.collect()
    assert gone() is None
