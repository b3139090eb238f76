"""The device that computes, and copies to it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch

from fide_plugins.errors import DeviceError
from fide_plugins.types import Float32

__all__ = ["as_here", "has_bfloat16", "on_device", "repeatable", "resolve_device"]

_GPU = ("gpu", "nvidia")  # what people call a device that PyTorch calls "cuda"
_CUDNN = threading.RLock()  # its settings belong to the whole process


def resolve_device(
    device: str | torch.device = "auto", *, for_network: bool = True
) -> torch.device:
    """Device of that name; a CUDA device without a number is the current one.

    ``"auto"`` is CUDA if it is available and a network computes there (`for_network`), otherwise
    the CPU: features that NumPy needs after a few steps are computed faster where the images are.

    Raises
    ------
    DeviceError
        PyTorch does not know the name, or this machine has no such device.
    """
    if isinstance(device, str) and device == "auto":
        device = "cuda" if for_network and torch.cuda.is_available() else "cpu"
    try:
        resolved = torch.device(device)
        torch.empty(0, device=resolved)
    except (RuntimeError, AssertionError, TypeError, NotImplementedError) as e:
        reason = str(e).splitlines()[0]
        if str(device).lower() in _GPU:
            reason = "write 'cuda'"
        raise DeviceError(f"no device {device!r} here ({reason}); 'auto' or 'cpu' works") from e
    if resolved.type == "cuda" and resolved.index is None:  # each thread has its own current device
        return torch.device("cuda", torch.cuda.current_device())
    return resolved


def as_here(device: torch.device) -> Callable[[], AbstractContextManager[None]]:
    """Context in which another thread computes on the current CUDA stream of this thread.

    Its work starts after the work that this thread has queued; at the end the context waits for
    the stream.
    """
    if device.type != "cuda":
        return nullcontext
    stream = torch.cuda.current_stream(device)

    @contextmanager
    def there() -> Iterator[None]:
        with torch.cuda.device(device), torch.cuda.stream(stream):
            try:
                yield
            finally:
                stream.synchronize()

    return there


@contextmanager
def repeatable(device: torch.device) -> Iterator[None]:
    """Context in which the gradients of convolutions are the same every time, on a GPU, too.

    Otherwise cuDNN may choose by time, and add in another order each time.  The settings are
    PyTorch's, for the process; they are as before afterwards, so threads that need a GPU for this
    take turns.
    """
    if device.type != "cuda":
        yield
        return
    cudnn = torch.backends.cudnn
    with _CUDNN:
        before = cudnn.deterministic, cudnn.benchmark
        cudnn.deterministic, cudnn.benchmark = True, False
        try:
            yield
        finally:
            cudnn.deterministic, cudnn.benchmark = before


def on_device(batch: Float32, device: torch.device) -> torch.Tensor:
    """Canonical images as a tensor on the device, not to be modified; copies read-only arrays."""
    return (torch.from_numpy(batch) if batch.flags.writeable else torch.tensor(batch)).to(device)


def has_bfloat16(device: torch.device) -> bool:
    """Whether the device multiplies bfloat16 matrices in hardware, without emulation."""
    if device.type == "cuda":
        with torch.cuda.device(device):
            return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    if device.type == "cpu":
        known = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
        return any(bool(getattr(torch.cpu, name, bool)()) for name in known)
    return False
