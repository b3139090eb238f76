"""The loss `texture` compares what pictures are made of, not where."""

from __future__ import annotations

import numpy as np
import pytest

from fide_plugins import FIDE, encoders, losses
from fide_plugins.errors import ImageError
from fide_plugins.types import Float32


def texture(seed: int, wavelength: float = 8, red: float = 0.8, size: int = 64) -> Float32:
    """A random texture of two colors, whose waves have about that length in pixels."""
    rng = np.random.default_rng(seed)
    y, x = np.fft.fftfreq(size)[:, None], np.fft.fftfreq(size)[None]
    ring = np.exp(-2 * np.log(np.maximum(np.hypot(y, x), 1e-6) * wavelength) ** 2)
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(size, size))) * ring).real
    mix = 1 / (1 + np.exp(-3 * field / field.std()))[..., None]
    return np.asarray(mix * [red, 0.6, 0.3] + (1 - mix) * [0.2, 0.2, 0.4], np.float32)


@pytest.mark.parametrize("size", [(64, 64), (33, 50)])
def test_a_mirrored_picture_is_the_same(size: tuple[int, int]) -> None:
    picture = texture(0)[: size[0], : size[1]]
    loss = losses.make("texture", picture)
    mirrored = np.stack([picture[::-1], picture[:, ::-1], picture[::-1, ::-1]])
    assert (loss(mirrored) < 1e-6).all()
    tokens = encoders.make("texture")(np.stack([picture, *mirrored]))
    assert tokens.shape[:2] == (4, 1)
    np.testing.assert_allclose(tokens[1:], np.broadcast_to(tokens[:1], tokens[1:].shape), atol=1e-4)


def test_another_part_of_a_texture_is_nearer_than_another_texture() -> None:
    """For each of five targets, by a wide margin; pixel by pixel a flat color is nearer."""
    for seed in range(5):
        target = texture(seed)
        same = np.stack([texture(100 + seed), np.roll(target, (9, 20), (0, 1))])
        others = np.stack([texture(seed, wavelength=12), texture(seed, red=0.6)])
        flat = np.broadcast_to(target.mean((0, 1)), target.shape)[None]
        loss, mse = losses.make("texture", target), losses.make("mse", target)
        assert 2 * loss(same).max() < min(loss(others).min(), loss(flat)[0])
        assert mse(flat)[0] < mse(same).min()


def test_its_unit_is_the_difference_of_two_pictures_of_one_texture() -> None:
    values = [losses.make("texture", texture(k))([texture(100 + k)])[0] for k in range(5)]
    assert 0.1 < np.median(values) < 3


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_a_plain_target(value: float) -> None:
    target = np.full((32, 32, 3), value)
    loss = losses.make("texture", target)([target, np.abs(target - 0.1), texture(0, size=32)])
    assert loss[0] == 0 < loss[1] < np.inf and 0 < loss[2] < np.inf


def test_too_small_a_picture() -> None:
    with pytest.raises(ImageError, match="at least 8 pixels along each side, got 7 x 30"):
        losses.make("texture", np.zeros((7, 30)))
    with pytest.raises(ImageError, match="at least 8 pixels"):
        encoders.make("texture")(np.zeros((1, 7, 30, 3)))


@pytest.mark.thorough
def test_colors_of_a_texture_whose_places_are_random_are_found() -> None:
    """A renderer that draws another part each time; the mean squared error finds a flat color."""
    target, found = texture(1000, wavelength=8, red=0.8), []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        search = FIDE(2, target, loss="texture", encoder="texture", seed=seed)
        while search.evaluations < 150:
            x = search.ask_ready()
            images = [
                texture(int(rng.integers(10**9)), 4 + 12 * a, 0.3 + 0.7 * b)
                for a, b in np.asarray(x)
            ]
            search.tell(x, images)
        found.append(search.recommend() * [12, 0.7] + [4, 0.3])
    wavelength, red = np.median(found, axis=0)
    assert red == pytest.approx(0.8, abs=0.05) and wavelength == pytest.approx(8, rel=0.1)
