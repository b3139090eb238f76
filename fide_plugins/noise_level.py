"""How noisy an image is, told from it alone, by the pixels that are not the median around them.

Where a picture is flat, changes evenly, or has an edge, a pixel is the median of the 3 x 3 around
it, exactly, and in drawings most pixels are; in a path-traced image next to none is.  So the
median, over the pixels, of how far they are from it is zero of one and the scale of the noise of
the other (Hampel 1974, the median absolute deviation).  Of curved shading it is about nothing: what
a slope changes by from one pixel to the next.  It says nothing of noise that leaves half of the
image alone, and takes fine texture that covers more than half of it for noise.
"""

from __future__ import annotations

import numpy as np

from fide_plugins.images import Float32

__all__ = ["noise_level"]

ROWS = 28  # of pixels that are looked at, at least, if there are so many


def noise_level(image: Float32, clean: Float32) -> float:
    """Median of the largest difference of a pixel's colors between two images (H, W, 3), >= 0.

    `clean` is the image `despeckled`.  Of large images some rows are looked at, which is enough.
    """
    step = max(1, len(image) // ROWS)
    grain = np.abs(image[::step] - clean[::step])
    largest = np.maximum(np.maximum(grain[..., 0], grain[..., 1]), grain[..., 2]).ravel()
    return float(np.sort(largest)[len(largest) // 2])  # of ties, partition makes ten times the work
