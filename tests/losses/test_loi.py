from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr
from scipy.stats import wasserstein_distance

from fide_plugins.errors import OptionError
from fide_plugins.losses.loi import LocallyOrderlessLoss
from fide_plugins.losses.mse import MeanSquaredError

RNG = np.random.default_rng(7)
GLOBAL = [(0.0, np.inf)]  # scales: every pixel as it is, one histogram of the whole image


def disk(x: float, y: float = 0.5, size: int = 64) -> NDArray[np.float32]:
    """A red disk on blue, of 8 % of the side, with its center at (x, y)."""
    rows, columns = (np.mgrid[:size, :size] + 0.5) / size
    inside = np.clip(0.5 - (np.hypot(columns - x, rows - y) - 0.08) * size, 0, 1)[..., None]
    image: NDArray[np.float64] = inside * (0.9, 0.3, 0.2) + (1 - inside) * (0.2, 0.3, 0.4)
    return image.astype(np.float32)


def test_global_histograms_by_the_definition() -> None:
    """F_k = mean over all pixels of Phi((t_k - I) / beta), computed without grids."""
    a, b = RNG.random((2, 20, 30, 3), dtype=np.float32)
    loss = LocallyOrderlessLoss(a, tonal=0.1, tones=6, scales=GLOBAL)
    tones = np.linspace(-0.1, 1.1, 6)
    f, g = (ndtr((tones - x[..., None]) / 0.1).mean(axis=(0, 1)) for x in (a, b))
    expected = np.abs(f - g).sum(axis=1).mean() * (tones[1] - tones[0])
    np.testing.assert_allclose(loss.histograms(a)[0][0, 0], f, atol=2e-4)
    np.testing.assert_allclose(loss(b[None])[0], expected, atol=5e-4)


def weights(pixels: int, places: int, scale: float) -> NDArray[np.float64]:
    """Gaussians of that standard deviation around the centers of equal parts, cut off at 3."""
    distance = np.arange(pixels) - ((np.arange(places) + 0.5) * pixels / places - 0.5)[:, None]
    w = np.exp(-0.5 * (distance / scale) ** 2) * (np.abs(distance) <= 3 * scale)
    normalized: NDArray[np.float64] = w / w.sum(axis=1, keepdims=True)
    return normalized


@pytest.mark.parametrize(("spatial", "extent"), [(0.0, 4.0), (0.0, 11.0), (0.9, 5.0)])
def test_local_histograms_by_the_definition(spatial: float, extent: float) -> None:
    """As Koenderink and van Doorn give them, with scales in pixels.

    A blur by the spatial scale, a cumulative Gaussian of the tonal scale for each pixel, the mean
    of these over the extent.
    """
    image = RNG.random((24, 24, 3), dtype=np.float32)
    loss = LocallyOrderlessLoss(image, scales=[(spatial / 24, extent / 24)], tonal=0.15, tones=5)
    (histograms,) = loss.histograms(image)
    blur = weights(24, 24, spatial) if spatial else np.eye(24)
    blurred = np.einsum("ip,jq,pqc->ijc", blur, blur, image, optimize=True)
    isophotes = ndtr((np.linspace(-0.15, 1.15, 5) - blurred[..., None]) / 0.15)
    rows, columns = (weights(24, n, extent) for n in histograms.shape[:2])
    expected = np.einsum("ip,jq,pqck->ijck", rows, columns, isophotes)
    assert histograms.shape == expected.shape and rows.shape[0] == np.ceil(24 / extent)
    np.testing.assert_allclose(histograms, expected, atol=2e-4)


def test_the_three_scales_together() -> None:
    """As by default, each on a grid of its own: near what every pixel and every place gives."""
    a, b = (disk(x, size=96).astype(np.float64) for x in (0.3, 0.6))
    unit = 96.0
    total = 0.0
    loss = LocallyOrderlessLoss(a.astype(np.float32))
    for spatial, extent in ((0.025, 0.03), (0.025, 0.1), (0.025, 0.3), (0.1, 0.3)):
        blur, window = weights(96, 96, spatial * unit), weights(96, 96, extent * unit)
        histograms = []
        for image in (a, b):
            blurred = np.einsum("ip,jq,pqc->ijc", blur, blur, image, optimize=True)
            isophotes = ndtr((loss.tones - blurred[..., None]) / loss.tonal)
            orderless = np.einsum("ip,jq,pqck->ijck", window, window, isophotes, optimize=True)
            histograms.append(orderless)
        spacing = float(loss.tones[1] - loss.tones[0])
        total += np.abs(histograms[0] - histograms[1]).sum(axis=3).mean() * spacing / 4
    np.testing.assert_allclose(loss(b[None].astype(np.float32))[0], total, rtol=0.05)


def test_it_is_the_earth_mover_distance() -> None:
    """Fine tones, whole image: SciPy's 1-Wasserstein distance of the two sets of values."""
    a, b = RNG.random((40, 40, 3)), RNG.random((40, 40, 3)) ** 2
    loss = LocallyOrderlessLoss(a, tonal=0.01, tones=400, scales=GLOBAL)
    expected = [wasserstein_distance(a[..., c].ravel(), b[..., c].ravel()) for c in range(3)]
    np.testing.assert_allclose(loss(b[None])[0], np.mean(expected), rtol=0.01)


@pytest.mark.parametrize("value", [0.2, 0.5, 0.8])
def test_gray_levels_are_as_far_as_their_tones(value: float) -> None:
    loss = LocallyOrderlessLoss(np.full((30, 30), 0.3))
    np.testing.assert_allclose(loss(np.full((1, 30, 30), value))[0], abs(value - 0.3), rtol=0.04)


def test_order_within_the_extent_is_forgotten() -> None:
    image = RNG.random((24, 24, 3), dtype=np.float32)
    shuffled = RNG.permutation(image.reshape(-1, 3)).reshape(image.shape)
    whole = LocallyOrderlessLoss(image, scales=GLOBAL)
    assert whole(shuffled[None])[0] < 1e-6
    assert whole(image[None, ::-1])[0] < 1e-6
    assert MeanSquaredError(image)(shuffled[None])[0] > 0.1


def test_order_beyond_the_extent_is_not_forgotten() -> None:
    image = np.zeros((32, 32, 3), np.float32)
    image[:, :16] = 1.0
    swapped = image[:, ::-1]
    assert LocallyOrderlessLoss(image, scales=GLOBAL)(swapped[None])[0] < 1e-6
    by_extent = [
        LocallyOrderlessLoss(image, scales=[(0.0, extent)])(swapped[None])[0]
        for extent in (0.05, 0.2, 0.5, 2.0)
    ]
    assert np.all(np.diff(by_extent) < 0)
    assert by_extent[0] > 0.9 and by_extent[-1] < 0.1


def test_inner_scale_forgets_fine_detail() -> None:
    checkered = (np.indices((32, 32)).sum(axis=0) % 2).astype(np.float32)
    gray = np.full((1, 32, 32), 0.5, np.float32)
    fine = LocallyOrderlessLoss(checkered, scales=[(0.0, 0.2)])(gray)[0]
    blurred = LocallyOrderlessLoss(checkered, scales=[(0.1, 0.2)])(gray)[0]
    assert fine > 0.35 and blurred < 0.01


def test_histograms_are_cumulative_shares() -> None:
    loss = LocallyOrderlessLoss(RNG.random((50, 60, 3)))
    for histogram in loss.histograms(loss.target):
        assert histogram.dtype == np.float32 and histogram.shape[2:] == (3, 8)
        assert histogram.min() >= 0 and histogram.max() <= 1 + 1e-5
        assert np.all(np.diff(histogram, axis=3) > -1e-6)


def test_the_slope_leads_home_from_afar() -> None:
    """Where a small disk does not overlap its target, mse is flat; loi is monotone."""
    positions = np.linspace(0.15, 0.5, 36)
    images = np.stack([disk(x) for x in positions])
    assert np.all(np.diff(LocallyOrderlessLoss(disk(0.5))(images)) < 0)
    mse = MeanSquaredError(disk(0.5))(images[:15])
    assert np.ptp(mse) < 0.01 * mse.mean()


@pytest.mark.parametrize(
    "options",
    [
        {"scales": []},
        {"scales": [(0.1,)]},
        {"scales": [(-0.1, 0.1)]},
        {"scales": [(0.1, -1.0)]},
        {"scales": [(0.1, np.nan)]},
        {"scales": [(np.inf, 0.1)]},
        {"scales": 3},
        {"tonal": 0.0},
        {"tonal": np.nan},
        {"tonal": "wide"},
        {"tones": 1},
        {"tones": 2.5},
    ],
)
def test_odd_options_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match="must be .*not"):
        LocallyOrderlessLoss(np.zeros((4, 4)), **options)
