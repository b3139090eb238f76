"""How features are stored (acceptance point 6)."""

from __future__ import annotations

import base64

import numpy as np
import pytest
import torch

from fide_adapters.optuna.images import BYTES, Codec

SHAPES = [(1, 1), (4, 768), (196, 20), (201, 384), (2600, 3), (2601, 5), (4096, 64)]


def tokens(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random(shape).astype(np.float32))


def stored(codec: Codec, image: torch.Tensor) -> torch.Tensor:
    found = codec.unpack(codec.pack(image))
    assert found is not None and found.shape == image.shape and found.dtype == torch.float32
    return found


@pytest.mark.parametrize("leading", [None, 3])
@pytest.mark.parametrize("shape", SHAPES)
def test_any_features_fit_and_the_target_loses_nothing(
    shape: tuple[int, int], leading: int | None
) -> None:
    target, image = tokens(*shape), tokens(*shape, seed=1)
    codec = Codec(target, leading, b"name")
    code = codec.pack(image)
    assert len(base64.b64decode(code)) <= BYTES
    assert codec.pack(stored(codec, image)) == code  # nothing more is lost the second time
    torch.testing.assert_close(stored(codec, target), target, rtol=0, atol=0)


@pytest.mark.parametrize(("shape", "channels"), [((196, 20), 3), ((4, 20), 20)])
@pytest.mark.parametrize("distance", [1e-3, 0.1, 1.0])
def test_channels_that_are_stored_are_precise_near_the_target(
    shape: tuple[int, int], channels: int, distance: float
) -> None:
    target = tokens(*shape)
    image = target + distance * (tokens(*shape, seed=1) - 0.5)
    error = (stored(Codec(target, 3, b"name"), image) - image)[:, :channels].abs()
    assert (error <= 1e-3 + 0.04 * (image - target)[:, :channels].abs()).all()


def test_scalar_products_survive() -> None:
    """Differences of many images, as a linear model sees them."""
    rng = np.random.default_rng(0)
    effects = rng.standard_normal((60, 10)) @ (rng.standard_normal((10, 196 * 20)) * 0.05)
    images = torch.from_numpy(effects.reshape(60, 196, 20).astype(np.float32))
    target = tokens(196, 20)
    codec = Codec(target, 3, b"name")
    seen = torch.stack([stored(codec, target + image) for image in images]) - target
    for channels in (slice(0, 3), slice(None)):
        true, kept = images[..., channels].flatten(1), seen[..., channels].flatten(1)
        products = np.corrcoef((true @ true.T).ravel(), (kept @ kept.T).ravel())[0, 1]
        assert products > 0.95


def test_it_is_the_same_for_everybody() -> None:
    """The code of a stated image, which must not change without a change of the format."""
    target = torch.linspace(0, 1, 60).reshape(3, 20)
    codec = Codec(target, 3, b"dense-1")
    code = codec.pack(target.flip(0) ** 2)
    assert code == CODE
    assert codec.digest == Codec(target + 1, None, b"dense-1").digest
    assert codec.digest != Codec(target, 3, b"dense-2").digest


CODE = "SktLR0dHR0hISElJSUpKSktLTEzBwMDExMTDw8PDw8PDw8TExMTFxbCvr7OzsrKysrGxsbGxsLCwsLCw"


@pytest.mark.parametrize("code", ["", "AAAA", "not base64!", "é", "A" * 10**6])
def test_what_is_no_code_is_refused(code: str) -> None:
    assert Codec(tokens(196, 20), 3, b"name").unpack(code) is None
