"""No image goes through a network twice, and the tokens are those of an encoder without memory."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.encoders.cache import TokenCache
from fide_plugins.fide import FIDE
from fide_plugins.types import Float32

RNG = np.random.default_rng(15)
IMAGES = RNG.random((8, 6, 5, 3), dtype=np.float32)
BYTES = 4 * 2 * 3  # of an image's tokens


class Recorder:
    """An encoder of 2 tokens with 3 channels, which remembers what it was shown."""

    def __init__(self) -> None:
        self.seen: list[bytes] = []

    def __call__(self, batch: Float32) -> Tensor:
        self.seen += [image.tobytes() for image in batch]
        return torch.tensor(batch[:, :2, 0])


def test_every_image_is_encoded_once() -> None:
    cache, encode = TokenCache(), Recorder()
    order = [0, 1, 0, 2, 2, 1, 3]
    tokens = cache.tokens(IMAGES[order], encode)
    assert torch.equal(tokens, torch.tensor(IMAGES[order][:, :2, 0]))
    assert encode.seen == [IMAGES[i].tobytes() for i in (0, 1, 2, 3)] and len(cache) == 4
    again = cache.tokens(IMAGES[[3, 4, 0]], encode)
    assert torch.equal(again, torch.tensor(IMAGES[[3, 4, 0]][:, :2, 0]))
    assert encode.seen[4:] == [IMAGES[4].tobytes()]


def test_memory_is_bounded_and_the_oldest_goes_first() -> None:
    cache, encode = TokenCache(3 * BYTES), Recorder()
    cache.tokens(IMAGES[:3], encode)
    cache.tokens(IMAGES[:1], encode)  # used again, so 1 is now the oldest
    cache.tokens(IMAGES[3:4], encode)
    assert len(cache) == 3 and len(encode.seen) == 4
    cache.tokens(IMAGES[[0, 2, 3]], encode)
    assert len(encode.seen) == 4
    cache.tokens(IMAGES[1:2], encode)
    assert len(encode.seen) == 5
    assert torch.equal(cache.tokens(IMAGES, encode), torch.tensor(IMAGES[:, :2, 0]))
    assert len(cache) == 3
    nothing = TokenCache(0)
    assert torch.equal(nothing.tokens(IMAGES, encode), torch.tensor(IMAGES[:, :2, 0]))
    assert len(nothing) == 0


class Slow(OrderedDict[bytes, Tensor]):
    """A dictionary between whose answer and its use another thread gets its turn."""

    def __contains__(self, key: object) -> bool:
        found = super().__contains__(key)
        time.sleep(1e-4)
        return found


def test_threads_share_one() -> None:
    """Nothing is counted twice or lost, though all of them drop what the others look for."""
    cache = TokenCache(3 * BYTES)
    cache._tokens = Slow()

    def look(seed: int) -> bool:
        order = np.random.default_rng(seed).integers(len(IMAGES), size=4)
        tokens = cache.tokens(IMAGES[order], Recorder())
        return torch.equal(tokens, torch.tensor(IMAGES[order][:, :2, 0]))

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(look, range(40)))
    assert cache._bytes == sum(tokens.nbytes for tokens in cache._tokens.values()) == 3 * BYTES


def test_no_images() -> None:
    assert TokenCache().tokens(IMAGES[:0], Recorder()).shape == (0, 2, 3)


@pytest.mark.parametrize("name", ["dinov3", "vgg19"])
def test_networks_have_one(
    name: str, make: Callable[..., PatchEncoder], monkeypatch: pytest.MonkeyPatch
) -> None:
    images = RNG.random((4, 32, 32, 3), dtype=np.float32)
    encoder, seen = make(name), list[int]()
    once = make(name)(images)
    features: Callable[[Tensor], Tensor] = encoder._features  # type: ignore[attr-defined]

    def counted(x: Tensor) -> Tensor:
        seen.append(len(x))
        return features(x)

    monkeypatch.setattr(encoder, "_features", counted)
    for pieces in (images[:3], images[1:], images):
        encoder(pieces)
    assert torch.equal(encoder(images), once)
    assert len(seen) == 2  # batches of one size, of which the second held what was left


def test_a_run_is_the_same_with_another_history_of_the_cache(
    make: Callable[..., PatchEncoder], dino_folders: dict[str, object]
) -> None:
    name = f"dinov3:{dino_folders['dinov3']}"
    target = np.full((16, 16, 3), 0.5, np.float32)

    def render(X: np.ndarray) -> Float32:
        rounded = np.round(X[:, None, None, :3], 1)  # so that candidates share images
        return np.broadcast_to(rounded, (len(X), 16, 16, 3)).astype(np.float32)

    runs = []
    for memory in (2**20, 0):
        opt = FIDE(3, target, encoder=name, popsize=8, seed=1)
        opt.encoder._cache.most_bytes = memory  # type: ignore[attr-defined]
        for _ in range(6):
            X = opt.ask()
            opt.tell(X, render(X))
        runs.append(opt.ask())
    np.testing.assert_array_equal(runs[0], runs[1])
