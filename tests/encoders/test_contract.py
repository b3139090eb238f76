"""What every encoder promises."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pytest
import torch

from fide_plugins import encoders
from fide_plugins.encoders import base
from fide_plugins.encoders.base import PatchEncoder
from fide_plugins.errors import ImageError

Make: TypeAlias = Callable[..., PatchEncoder]

RNG = np.random.default_rng(2)
SIZES = [(8, 8), (17, 16), (30, 50), (64, 8), (112, 112)]

every_encoder = pytest.mark.parametrize("name", encoders.names())
every_size = pytest.mark.parametrize("size", SIZES)


@every_encoder
@every_size
def test_shape_and_type(name: str, size: tuple[int, int], make: Make) -> None:
    encoder = make(name)
    tokens = encoder(RNG.random((3, *size, 3), dtype=np.float32))
    assert tokens.dtype == torch.float32 and tokens.shape == (3, *encoder.shape(*size))
    assert torch.isfinite(tokens).all() and not tokens.requires_grad
    assert encoder(np.zeros((0, *size, 3), np.uint8)).shape == (0, *encoder.shape(*size))


@every_encoder
def test_a_user_who_raises_floating_point_errors_gets_the_same_tokens(
    name: str, make: Make
) -> None:
    image = RNG.random((112, 112, 3))
    images = np.stack([image, np.zeros_like(image), image * 1e-50, image * 1e-30])
    expected = make(name)(images)
    with np.errstate(all="raise"):
        assert torch.equal(make(name)(images), expected)


@every_encoder
@every_size
def test_tokens_of_an_image_do_not_depend_on_its_batch(
    name: str, size: tuple[int, int], make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = RNG.random((7, *size, 3), dtype=np.float32)
    encoder = make(name)
    together = encoder(images)
    for i, image in enumerate(images):
        assert torch.equal(encoder(image[None])[0], together[i])
    monkeypatch.setattr(base, "CHUNK", 3 * images[0].size)
    assert torch.equal(encoder(images), together)


@every_encoder
def test_images_are_neither_changed_nor_kept(name: str, make: Make) -> None:
    images = RNG.random((2, 32, 32, 3), dtype=np.float32)
    before = images.copy()
    tokens = make(name)(images)
    kept = tokens.clone()
    np.testing.assert_array_equal(images, before)
    images[:] = 0
    assert torch.equal(tokens, kept)


@every_encoder
def test_anything_that_is_a_batch(name: str, make: Make) -> None:
    images = RNG.integers(0, 256, (2, 32, 32, 3), np.uint8)
    encoder = make(name)
    expected = encoder(images / np.float32(255))
    assert torch.equal(encoder(images), expected)
    assert torch.equal(encoder(torch.from_numpy(images).permute(0, 3, 1, 2)), expected)
    with pytest.raises(ImageError, match="finite"):
        encoder(np.full((1, 32, 32, 3), np.nan))
    with pytest.raises(ImageError, match=r"write image\[None\]"):
        encoder(images[0])


@every_encoder
def test_global_state_is_left_alone(name: str, make: Make) -> None:
    images = np.zeros((1, 32, 32, 3), np.float32)
    state, dtype = torch.get_rng_state(), torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        tokens = make(name)(images)
        assert torch.get_default_dtype() == torch.float64 and tokens.dtype == torch.float32
    finally:
        torch.set_default_dtype(dtype)
    assert torch.equal(torch.get_rng_state(), state) and torch.is_grad_enabled()


@every_encoder
def test_tokens_can_be_trained_on(name: str, make: Make) -> None:
    tokens = make(name)(RNG.random((2, 32, 32, 3), dtype=np.float32))
    weight = torch.ones(tokens.shape[2], requires_grad=True)
    (tokens @ weight).sum().backward()  # type: ignore[no-untyped-call]
    assert weight.grad is not None


@every_encoder
def test_named_and_versioned(name: str, make: Make) -> None:
    encoder = make(name)
    assert encoder.name.partition(":")[0] == name and encoder.version.startswith(f"{name}-")
    pretrained = name in ("dinov3", "efficientnet", "vgg19")
    assert (encoder.weights_digest is not None) == pretrained
    assert encoder.weights_digest is None or encoder.weights_digest in encoder.version
