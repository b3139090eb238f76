"""Batch sizes that shrink if a device runs out of memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from fide_plugins.runtime.warn import warn_user

__all__ = ["BatchSize", "is_out_of_gpu_memory", "is_out_of_memory", "stack"]

# Messages of PyTorch about the memory of the CPU, and of it and libraries that it calls about a
# GPU; they come in a plain RuntimeError.
_OF_CPU = ("can't allocate memory", "not enough memory")
_OF_GPU = ("out of memory", "ALLOC_FAILED")


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error means that a device or the CPU has too little memory."""
    if isinstance(error, torch.OutOfMemoryError | MemoryError):
        return True
    return isinstance(error, RuntimeError) and _says(error, *_OF_CPU, *_OF_GPU)


def is_out_of_gpu_memory(error: BaseException) -> bool:
    """Whether an error means that a GPU has too little memory."""
    if isinstance(error, torch.OutOfMemoryError):
        return True
    return isinstance(error, RuntimeError) and _says(error, *_OF_GPU) and not _says(error, *_OF_CPU)


def _says(error: BaseException, *texts: str) -> bool:
    return any(text in str(error) for text in texts)


def stack(tensors: Sequence[Tensor]) -> Tensor:
    """`torch.stack`; on the CPU if the device has too little memory for the result."""
    try:
        return torch.stack(list(tensors))
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
    return torch.stack([tensor.cpu() for tensor in tensors])


class BatchSize:
    """A batch size that is halved whenever the device runs out of memory.

    size: initial batch size; what: name of the items, for messages.
    """

    def __init__(self, size: int, what: str) -> None:
        self.size, self.what = size, what
        self._warned = False

    def each(self, work: Callable[[slice], object], n: int) -> None:
        """Call `work` on consecutive batches of n items.

        If the device runs out of memory, the batch is repeated in halves, and all later batches
        have that size; a RuntimeWarning reports it once.  So `work` must change nothing before it
        raises.  An error for a batch of one item is raised.
        """
        start = 0
        while start < n:
            end = min(start + self.size, n)
            try:
                work(slice(start, end))
            except (RuntimeError, MemoryError) as error:
                if not is_out_of_memory(error):
                    raise
                if end - start == 1:
                    remedy = "device='cpu', or smaller images"
                    error.add_note(f"the memory is too small for one of the {self.what}: {remedy}")
                    raise
            else:
                start = end
                continue
            self._shrink((end - start) // 2)  # only here: the exception has released its memory

    def _shrink(self, size: int) -> None:
        self.size = size
        if torch.cuda.is_available():
            torch.cuda.empty_cache()
        if not self._warned:
            self._warned = True
            warn_user(
                f"the device's memory is too small for so many {self.what} at once; "
                f"from now on {size}"
            )
