import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

from fide_plugins.losses import loi
from fide_plugins.losses.loi import LocallyOrderlessLoss

RNG = np.random.default_rng(7)


def disk(x: float, y: float = 0.5, size: int = 64) -> NDArray[np.float32]:
    """A red disk on blue, of 8 % of the side, with its center at (x, y)."""
    rows, columns = (np.mgrid[:size, :size] + 0.5) / size
    inside = np.clip(0.5 - (np.hypot(columns - x, rows - y) - 0.08) * size, 0, 1)[..., None]
    image: NDArray[np.float64] = inside * (0.9, 0.3, 0.2) + (1 - inside) * (0.2, 0.3, 0.4)
    return image.astype(np.float32)


def weights(pixels: int, places: int, scale: float) -> NDArray[np.float64]:
    """Gaussians of that standard deviation around the centers of equal parts, cut off at 3."""
    distance = np.arange(pixels) - ((np.arange(places) + 0.5) * pixels / places - 0.5)[:, None]
    w = np.exp(-0.5 * (distance / scale) ** 2) * (np.abs(distance) <= 3 * scale)
    normalized: NDArray[np.float64] = w / w.sum(axis=1, keepdims=True)
    return normalized


@pytest.mark.parametrize(("spatial", "extent"), [(0.0, 4.0), (0.0, 11.0), (0.9, 5.0)])
def test_local_histograms_by_the_definition(
    spatial: float, extent: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Koenderink and van Doorn give them, with scales in pixels.

    A blur by the spatial scale, a cumulative Gaussian of the tonal scale for each pixel, the mean
    of these over the extent.
    """
    image = RNG.random((24, 24, 3), dtype=np.float32)
    monkeypatch.setattr(loi, "SCALES", {spatial / 24: (extent / 24,)})
    (histograms,) = LocallyOrderlessLoss(image).histograms(image)
    blur = weights(24, 24, spatial) if spatial else np.eye(24)
    blurred = np.einsum("ip,jq,pqc->ijc", blur, blur, image, optimize=True)
    isophotes = ndtr((np.linspace(-1 / 8, 9 / 8, 8) - blurred[..., None]) * 8)
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
            isophotes = ndtr((loi.TONES - blurred[..., None]) / loi.TONAL)
            orderless = np.einsum("ip,jq,pqck->ijck", window, window, isophotes, optimize=True)
            histograms.append(orderless)
        spacing = float(loi.TONES[1] - loi.TONES[0])
        total += np.abs(histograms[0] - histograms[1]).sum(axis=3).mean() * spacing / 4
    np.testing.assert_allclose(loss(b[None].astype(np.float32))[0], total, rtol=0.05)
