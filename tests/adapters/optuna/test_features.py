"""How features are stored (acceptance point 6)."""

from __future__ import annotations

import base64

import numpy as np
import pytest
import torch

from fide_adapters.optuna.images import BYTES, Codec

SHAPES = [(1, 1), (1, 20), (4, 768), (13, 3), (196, 20), (256, 20), (201, 384), (1300, 3)]
SHAPES += [(1301, 5), (4096, 64)]


def tokens(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random(shape).astype(np.float32))


@pytest.mark.parametrize("leading", [None, 3])
@pytest.mark.parametrize("shape", SHAPES)
def test_any_features_fit(shape: tuple[int, int], leading: int | None) -> None:
    codec = Codec(tokens(*shape), leading, "name")
    code = codec.pack(tokens(*shape, seed=1))
    assert len(base64.b64decode(code)) <= BYTES
    assert len(code) <= 1736
    again = codec.unpack(code)
    assert again is not None and again.shape == shape and again.dtype == torch.float32
    assert codec.pack(again) == code  # nothing more is lost the second time


@pytest.mark.parametrize("shape", SHAPES)
def test_the_target_itself_loses_nothing(shape: tuple[int, int]) -> None:
    target = tokens(*shape)
    codec = Codec(target, 3, "name")
    again = codec.unpack(codec.pack(target))
    assert again is not None
    torch.testing.assert_close(again, target, rtol=0, atol=0)


@pytest.mark.parametrize("distance", [1e-3, 1e-2, 0.1, 1.0])
def test_leading_channels_are_precise_near_the_target(distance: float) -> None:
    target = tokens(196, 20)
    codec = Codec(target, 3, "name")
    image = target + distance * (tokens(196, 20, seed=1) - 0.5)
    again = codec.unpack(codec.pack(image))
    assert again is not None
    error = (again - image)[:, :3].abs()
    assert (error <= 1e-3 + 0.04 * (image - target)[:, :3].abs()).all()


def test_all_of_few_channels_are_precise() -> None:
    target, image = tokens(4, 20), tokens(4, 20, seed=1)
    codec = Codec(target, 3, "name")
    again = codec.unpack(codec.pack(image))
    assert again is not None
    assert ((again - image).abs() <= 1e-3 + 0.04 * (image - target).abs()).all()


def test_scalar_products_survive() -> None:
    """Differences of many images, as a linear model sees them: correlated by 0.95 with the true."""
    rng = np.random.default_rng(0)
    causes = rng.standard_normal((60, 10))
    effect = rng.standard_normal((10, 196 * 20)) * 0.05
    images = torch.from_numpy((causes @ effect).reshape(60, 196, 20).astype(np.float32))
    target = tokens(196, 20)
    codec = Codec(target, 3, "name")
    stored = [codec.unpack(codec.pack(target + image)) for image in images]
    seen = torch.stack([s for s in stored if s is not None]) - target
    for channels in (slice(0, 3), slice(None)):
        true = images[..., channels].flatten(1)
        kept = seen[..., channels].flatten(1)
        products = np.corrcoef((true @ true.T).ravel(), (kept @ kept.T).ravel())[0, 1]
        assert products > 0.95


def test_equal_patches_are_equal_in_store() -> None:
    target, image = tokens(196, 20), tokens(196, 20, seed=1)
    moved = image.clone()
    moved[50:60] += 0.2
    codec = Codec(target, 3, "name")
    before, after = codec.unpack(codec.pack(image)), codec.unpack(codec.pack(moved))
    assert before is not None and after is not None
    changed = (before != after).any(dim=1)
    assert changed[50:60].all() and int(changed.sum()) == 10


def test_it_is_the_same_for_everybody() -> None:
    """The code of a stated image, which must not change without a change of the format."""
    target = torch.linspace(0, 1, 60).reshape(3, 20)
    code = Codec(target, 3, "dense-1").pack(target.flip(0) ** 2)
    assert code == (
        "SktLwcDAsK+vR0dHR0hISElJSUpKSktLTEzExMTDw8PDw8PDw8TExMTFxbOzsrKysrGxsbGxsLCwsLCw"
    )
    assert Codec(target, 3, "dense-1").digest == Codec(target + 1, None, "dense-1").digest
    assert Codec(target, 3, "dense-1").digest != Codec(target, 3, "dense-2").digest


@pytest.mark.parametrize("code", ["", "AAAA", "not base64!", "é", "A" * 1696, "A" * 10**6])
def test_what_is_no_code_is_refused(code: str) -> None:
    assert Codec(tokens(196, 20), 3, "name").unpack(code) is None
