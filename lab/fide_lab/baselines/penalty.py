"""What libraries cannot bear is kept from them: losses that are no numbers, and their warnings."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

__all__ = ["Penalty", "quietly", "worse_than"]


def worse_than(loss: float) -> float:
    """A finite loss above a finite one, unless that is the largest number there is."""
    return min(loss + 1.0 + abs(loss), sys.float_info.max)


class Penalty:
    """Finite losses in place of those that are not: worse than all before."""

    def __init__(self) -> None:
        self._worst: float | None = None

    def __call__(self, loss: float) -> float:
        """`loss` itself if it is finite."""
        if np.isfinite(loss):
            self._worst = loss if self._worst is None else max(loss, self._worst)
            return loss
        return worse_than(0.0 if self._worst is None else self._worst)


@contextmanager
def quietly() -> Iterator[None]:
    """Without a library's warnings, as of flat or failed functions, which here are no error."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
