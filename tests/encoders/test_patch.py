import numpy as np
import pytest

from fide_plugins.encoders.patch import RawPatchEncoder
from fide_plugins.errors import ImageError

RNG = np.random.default_rng(4)


def test_tokens_are_pixels() -> None:
    images = RNG.random((2, 48, 32, 3), dtype=np.float32)
    tokens = RawPatchEncoder()(images).numpy()
    assert tokens.shape == (2, 6, 768)
    for t, (row, column) in enumerate([(0, 0), (0, 16), (16, 0), (16, 16), (32, 0), (32, 16)]):
        patch = images[:, row : row + 16, column : column + 16]
        np.testing.assert_array_equal(tokens[:, t], patch.reshape(2, 768))


@pytest.mark.parametrize(
    ("size", "tokens"),
    [
        ((224, 224), 196),
        ((8, 8), 1),
        ((23, 24), 2),
        ((39, 40), 6),
        ((16, 4096), 256),
        ((100, 100), 36),
    ],
)
def test_sides_go_to_the_nearest_multiple(size: tuple[int, int], tokens: int) -> None:
    encoder = RawPatchEncoder()
    assert encoder.shape(*size) == (tokens, 768)
    images = np.full((1, *size, 3), 0.25, np.float32)
    np.testing.assert_allclose(encoder(images).numpy(), np.full((1, tokens, 768), 0.25), atol=1e-6)


@pytest.mark.parametrize("size", [(7, 100), (100, 1), (1, 1)])
def test_too_small(size: tuple[int, int]) -> None:
    message = rf"at least 8 x 8 pixels.*got {size[0]} x {size[1]} .*'dense'"
    with pytest.raises(ImageError, match=message):
        RawPatchEncoder()(np.zeros((1, *size, 3), np.float32))
