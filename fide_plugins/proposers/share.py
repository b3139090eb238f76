"""How many candidates of a generation are proposed, by how they rank."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fide_plugins.points import Float64

__all__ = ["adapt_share"]


def adapt_share(
    share: float,
    losses: Float64,
    proposed: npt.NDArray[np.bool_],
    *,
    smallest: float,
    largest: float,
    rate: float = 0.1,
) -> float:
    """Raise `share` where proposals rank before samples, lower it where they rank behind.

    losses: (k,) of one generation; proposed: (k,), which of them a proposer made.
    The change is `rate` times the difference of the mean ranks, in units of k / 2; a generation of
    one kind only says nothing.  Losses that are not finite are tied for the last ranks.  The share
    stays within [smallest, largest]; from 0 it could not recover.
    """
    if proposed.all() or not proposed.any():
        return share
    order = np.argsort(losses, kind="stable")
    ranks = np.empty(len(losses))
    ranks[order] = np.arange(len(losses))
    failed = ~np.isfinite(losses)
    if failed.any():
        ranks[failed] = ranks[failed].mean()  # all behind the others, and none before another
    lead = (ranks[~proposed].mean() - ranks[proposed].mean()) / (len(losses) / 2)
    return float(np.clip(share + rate * lead, smallest, largest))
