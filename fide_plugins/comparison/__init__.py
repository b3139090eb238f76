"""How a target is compared with renders where the renderer did not draw it.

    FIDE(space, photo, photometric="auto", robust="auto", background="free")

A photograph differs from a renderer's picture by more than its parameters.  Loss, features and all
that learns from them see *adjusted* images, in which this is set aside: the light, what the
renderer does not know (robust differences) and what it does not draw, at a blur that may shrink as
the search goes on.  Renders stay as they are: `FIDE.best.image` is one.

Let t be the target, x a render, a its coverage, B a Gaussian blur.  Then

    y  = g x + o + q x^2      gain, offset and curve of each channel, or a smooth field of gains
    d  = B y - B t
    x' = B t + sqrt(B a) c d / sqrt(c^2 + |d|^2)

is compared with B t.  So the loss `mse` of x' is the mean of (B a) c^2 |d|^2 / (c^2 + |d|^2), that
of Geman and McClure.  What is not covered costs (1 - B a) b, with b 0.6 of what the target
itself would cost with its pixels in another order: the background is of the target's colors.
"""

from __future__ import annotations

from fide_plugins.comparison.comparison import Compared, Comparison
from fide_plugins.comparison.light import Light

__all__ = ["Compared", "Comparison", "Light"]
