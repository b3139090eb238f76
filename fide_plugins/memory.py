"""As many at once as a device's memory has room for."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch

__all__ = ["Room"]


class Room:
    """How many of something go through at once; learned from the device, which refuses.

    size: at first; what: these are, in words.
    """

    def __init__(self, size: int, what: str) -> None:
        self.size, self.what = size, what
        self._said = False

    def each(self, work: Callable[[slice], object], n: int) -> None:
        """Call `work` on consecutive pieces of n; on smaller ones where memory is short.

        A piece for which there was no room is tried again in halves, so `work` must not have
        changed anything by then; a RuntimeWarning says so, once.  Raises torch.OutOfMemoryError
        if there is no room for a single one.
        """
        start = 0
        while start < n:
            end = min(start + self.size, n)
            try:
                work(slice(start, end))
            except torch.OutOfMemoryError as error:
                if end - start == 1:
                    error.add_note(f"there is no room for one of the {self.what}: device='cpu'")
                    raise
            else:
                start = end
                continue
            self._shrink((end - start) // 2)  # not while the exception holds on to memory

    def _shrink(self, size: int) -> None:
        self.size = size
        if torch.cuda.is_available():
            torch.cuda.empty_cache()
        if not self._said:
            self._said = True
            warnings.warn(
                f"the device's memory is too small for so many {self.what} at once; "
                f"from now on {size}",
                RuntimeWarning,
                stacklevel=3,
            )
