"""What is changed in images while a model learns: reproducible, small, and each in its own way."""

from __future__ import annotations

import random
import sys
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins.errors import DependencyError
from fide_plugins.learning import augmentation
from fide_plugins.learning.augmentation import AUGMENT, augmented, check_installed

Change = Callable[[Tensor, torch.Generator], Tensor]
CHANGES: list[Change] = [change for change, _ in augmentation._CHANGES["photograph"]]
every_change = pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def waves(n: int = 40, size: int = 24) -> Tensor:
    """Images (n, 3, size, size) of soft structure in [0.2, 0.8], all the same."""
    rows, columns = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    planes = [torch.sin(rows / 3), torch.cos(columns / 4), torch.sin((rows + columns) / 5)]
    return (0.5 + 0.3 * torch.stack(planes)).expand(n, 3, size, size).contiguous()


def test_the_same_generator_makes_the_same_changes_and_no_other_is_used() -> None:
    images = waves()
    before = images.clone()
    state = torch.random.get_rng_state(), str(np.random.get_state()), random.getstate()
    first, again, other = (augmented(images, seeded(seed)) for seed in (3, 3, 4))
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert torch.equal(images, before)
    assert torch.equal(torch.random.get_rng_state(), state[0])
    assert (str(np.random.get_state()), random.getstate()) == state[1:]


@pytest.mark.parametrize("shape", [(1, 16, 16), (2, 17, 40), (5, 64, 64), (128, 16, 16)])
def test_images_stay_images(shape: tuple[int, int, int]) -> None:
    n, height, width = shape
    images = torch.rand(n, 3, height, width, generator=seeded())
    out = augmented(images, seeded(1))
    assert out.shape == images.shape and out.dtype == torch.float32
    assert float(out.min()) >= 0 and float(out.max()) <= 1


def test_some_images_stay_as_they_are() -> None:
    """A share of 3 / 4 times (1 / 2)^5: 2.3 %, of 2,000 images about 47."""
    images = waves(2000, 16)
    same = (augmented(images, seeded()) == images).flatten(1).all(1).sum()
    assert 15 < int(same) < 100


def test_nothing_is_changed_where_nobody_asks_for_it() -> None:
    images = waves()
    torch.testing.assert_close(augmented(images, seeded(), "none"), images, rtol=0, atol=0)


def test_what_two_renders_differ_in_moves_nothing_and_keeps_colors() -> None:
    """Focus and noise alone: flat images keep their color but for noise, and edges their place."""
    flat = torch.full((400, 3, 16, 16), 0.4)
    mean = augmented(flat, seeded(), "render").mean((2, 3))
    assert float((mean - 0.4).abs().max()) < 6 * 0.02 / 16  # six standard errors of the noise
    rows = torch.linspace(0.2, 0.8, 16)[:, None].expand(400, 3, 16, 16).contiguous()
    changed = (augmented(rows, seeded(), "render") - rows)[:, :, 2:-2, 2:-2].mean((1, 2, 3))
    assert float(changed.abs().max()) < 6 * 0.02 / (3 * 144) ** 0.5
    moved = (augmented(rows, seeded()) - rows)[:, :, 2:-2, 2:-2].mean((1, 2, 3))
    assert float(moved.abs().max()) > 0.01


@pytest.mark.parametrize("augment", AUGMENT)
def test_each_way_is_reproducible(augment: str) -> None:
    first, again = (augmented(waves(), seeded(3), augment) for _ in range(2))
    assert torch.equal(first, again)


@every_change
def test_each_image_is_changed_in_its_own_way(change: Change) -> None:
    images = waves()
    out = change(images, seeded())
    assert len({tuple(image.flatten().tolist()) for image in out}) > len(images) // 2


@pytest.mark.parametrize("change", CHANGES[1:], ids=lambda change: change.__name__)
def test_a_change_of_everything_is_small(change: Change) -> None:
    """But for what is in front, the first, which hides what is behind."""
    images = waves()
    assert float((change(images, seeded()) - images).abs().mean()) < 0.05


def test_shifts_are_of_half_a_pixel_at_most_and_go_both_ways() -> None:
    """On a ramp of one gray level a pixel, the change is the shift."""
    ramp = (torch.arange(32.0) / 100).expand(200, 3, 32, 32).contiguous()
    moved = augmentation._shifted(ramp, seeded())
    shift = 100 * (moved - ramp)[:, :, 2:-2, 2:-2]
    assert float(shift.abs().max()) <= 0.5 + 1e-4
    assert float(shift.min()) < -0.4 and float(shift.max()) > 0.4
    assert float((shift.amax((1, 2, 3)) - shift.amin((1, 2, 3))).max()) < 1e-3  # all of an image


def test_blurring_keeps_flat_images_and_the_mean() -> None:
    flat = torch.full((9, 3, 16, 16), 0.3)
    torch.testing.assert_close(augmentation._blurred(flat, seeded()), flat)
    spot = torch.zeros(9, 3, 15, 15)
    spot[:, :, 7, 7] = 1
    soft = augmentation._blurred(spot, seeded())
    torch.testing.assert_close(soft.sum((2, 3)), torch.ones(9, 3))
    assert float(soft[:, :, 7, 7].min()) > 0.2 and float(soft[:, :, 7, 7].max()) <= 1


def test_exposure_and_color_scale_each_channel() -> None:
    images = waves()
    gain = augmentation._exposed(images, seeded()) / images
    assert float((gain.amax((2, 3)) - gain.amin((2, 3))).max()) < 1e-5
    assert 0.9 < float(gain.min()) < 0.97 and 1.03 < float(gain.max()) < 1.1
    assert float((gain.amax((1, 2, 3)) - gain.amin((1, 2, 3))).max()) > 0.01


def test_gray_has_no_saturation_to_change() -> None:
    gray = waves()[:, :1].expand(-1, 3, -1, -1).contiguous()
    torch.testing.assert_close(augmentation._saturated(gray, seeded()), gray)


def test_what_is_in_front_is_one_rectangle_of_one_color() -> None:
    images = waves(200)
    hidden = (augmentation.in_front(images, seeded()) != images).any(1)  # (n, H, W)
    share = hidden.float().mean((1, 2))
    assert float(share.max()) <= (0.3 + 1 / 24) ** 2 and float(share.max()) > 0.04
    rows, columns = hidden.any(2), hidden.any(1)
    assert torch.equal(hidden, rows[:, :, None] & columns[:, None, :])


def test_noise_is_of_every_strength_up_to_its_largest() -> None:
    images = waves()
    deviation = (augmentation._noisy(images, seeded()) - images).flatten(1).std(1)
    assert 0.015 < float(deviation.max()) < 0.022 and float(deviation.min()) < 0.005


def test_a_missing_package_is_named_where_it_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kornia", None)
    check_installed("none")
    with pytest.raises(DependencyError, match=r"pip install kornia .*extra learn"):
        check_installed("render")
