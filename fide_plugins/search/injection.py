"""An injected candidate: a point that was never asked, in a generation."""

from __future__ import annotations

import numpy as np

from fide_plugins.types import Float64, Mask

__all__ = ["with_injected"]


def with_injected(
    point: Float64, loss: float, z: Float64, losses: Float64, injected: Mask
) -> tuple[Float64, Float64, Mask]:
    """Put a point (d,) with its loss in the place of the worst candidate if it is better.

    Of a generation: z (k, d), losses (k,), and which of them are injected, (k,).
    """
    worst = int(np.argmax(losses))
    if loss < losses[worst]:
        z[worst], losses[worst], injected[worst] = point, loss, True
    return z, losses, injected
