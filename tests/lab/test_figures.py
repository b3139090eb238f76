"""The loss curve of a run's picture."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from fide_lab.figures import draw_curve


def drawn(*losses: float) -> Any:
    """Axes with the curve of these losses."""
    axes = Figure().add_subplot()
    draw_curve(axes, np.array(losses), "mse")
    return axes


@pytest.mark.parametrize(
    ("losses", "scale", "best"),
    [
        ((1e-1, np.inf, 1e-6), "log", (1e-1, 1e-1, 1e-6)),
        ((1e-1, 1e-6, 0.0), "log", (1e-1, 1e-6, 0.0)),
        ((0.5, -0.5, 1.0), "linear", (0.5, -0.5, -0.5)),
        ((0.0, 0.0, 0.0), "linear", (0.0, 0.0, 0.0)),
    ],
)
def test_the_axis_is_logarithmic_wherever_it_can_be(
    losses: tuple[float, ...], scale: str, best: tuple[float, ...]
) -> None:
    axes = drawn(*losses)
    assert axes.get_yscale() == scale
    np.testing.assert_allclose(axes.lines[0].get_ydata(), best)
    assert len(axes.collections[0].get_offsets()) == int(np.isfinite(losses).sum())
