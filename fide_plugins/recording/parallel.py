"""Rounds that parallel renderers would need for a run.

W renderers need ceil(n / W) rounds for the n candidates of one generation; the next generation
starts when all are evaluated.  An optimizer that proposes one candidate at a time needs one round
for each, whatever the number of renderers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["WORKERS", "rounds"]

WORKERS = 8
"""Number of parallel renderers in the record of a run."""


def rounds(generations: npt.ArrayLike, workers: int = WORKERS) -> npt.NDArray[np.int64]:
    """Round, from 1, of each evaluation: (evaluations,).

    generations: number of candidates of each generation, in order.

    >>> rounds([3, 5], workers=2).tolist()
    [1, 1, 2, 3, 3, 4, 4, 5]
    """
    done, numbers = 0, []
    for size in np.asarray(generations, np.int64).tolist():
        mine: Any = np.arange(size) // workers + done + 1
        numbers.append(mine)
        done += -(-size // workers)
    return np.concatenate(numbers) if numbers else np.zeros(0, np.int64)
