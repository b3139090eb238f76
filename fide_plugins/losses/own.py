"""A user's own loss, any callable of a batch: it is tried on the target; no checkpoint holds it.

    def loss(images):              # float32 (n, H, W, 3) in [0, 1], a copy
        return values              # (n,) real numbers; array, tensor or list; the lower the better

For a list of targets it gets a list of such batches, one for each view.  The value of an image must
not depend on the rest of its batch.  NaN and infinity rank last, but not for the target itself.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fide_plugins.errors import LossError
from fide_plugins.losses.base import ImageLoss
from fide_plugins.runtime.registry import differs, tried_on
from fide_plugins.types import Float32

__all__ = ["check_loss", "loss_not_stored"]


def check_loss(loss: ImageLoss, target: Float32) -> None:
    """Call a loss with the target (H, W, 3) and its negative; raises LossError.

    What it gives for the two must be what it gives for each alone, and finite for the target.
    """
    what = f"the loss {loss.name!r}"
    compute: Callable[[Float32], object] = loss.compute
    together, alone = tried_on(target, compute, what, LossError)
    if not np.isfinite(together[0]):
        raise LossError(f"{what} must be finite for the target itself, but it is {together[0]}")
    if differs(together, alone):
        raise LossError(
            f"{what} must give an image the same value in every batch, but the target and its "
            f"negative have {together} together and {alone} alone; average over axes (1, 2, 3) "
            "only; where values are random, tell them: opt.tell(X, images, losses)"
        )


def loss_not_stored(images: object) -> object:
    """Loss of a loaded optimizer whose original loss was a callable; raises LossError."""
    raise LossError(
        "this optimizer was saved with a callable as its loss, which a checkpoint cannot hold; "
        "give it again, load(path, loss=...), or tell losses"
    )
