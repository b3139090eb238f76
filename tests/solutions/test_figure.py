"""The picture of several solutions: what stands where no image is stored."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from fide_plugins.solutions import _panel


def test_an_empty_panel_says_who_stores_images() -> None:
    axes = Figure().subplots(1, 2)
    _panel(axes[0], "2", "loss 1", None)
    _panel(axes[1], "3", "loss 1", np.zeros((4, 4, 3), np.float32))
    (text,) = axes[0].texts
    assert "fide fit renders them" in text.get_text() and "fit(out=)" in text.get_text()
    assert not axes[1].texts and len(axes[1].images) == 1
