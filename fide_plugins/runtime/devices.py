"""The device that computes: copies to it, batches that fit its memory, digests of networks."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from fide_plugins.errors import DeviceError
from fide_plugins.types import Float32

_GPU = ("gpu", "nvidia")  # what people call a device that PyTorch calls "cuda"
_CUDNN = threading.RLock()  # its settings belong to the whole process


def resolve_device(
    device: str | torch.device = "auto", *, for_network: bool = True
) -> torch.device:
    """Device of that name; a CUDA device without a number is the current one.

    ``"auto"`` is CUDA if it is available and a network computes there (`for_network`), otherwise
    the CPU.  Raises DeviceError for a name that PyTorch does not know, and a device that is not
    there.
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


@contextmanager
def repeatable(device: torch.device) -> Iterator[None]:
    """Context in which the gradients of convolutions are the same every time, on a GPU, too.

    Otherwise cuDNN may choose by time.  The settings are the process's: threads take turns.
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


# Messages of PyTorch and of libraries that it calls, in a plain RuntimeError.
_OF_CPU = ("can't allocate memory", "not enough memory")
_OF_GPU = ("out of memory", "ALLOC_FAILED")


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error means that a device or the CPU has too little memory."""
    said = isinstance(error, RuntimeError) and any(text in str(error) for text in _OF_CPU)
    return isinstance(error, MemoryError) or said or is_out_of_gpu_memory(error)


def is_out_of_gpu_memory(error: BaseException) -> bool:
    """Whether an error means that a GPU has too little memory."""
    said = isinstance(error, RuntimeError) and any(text in str(error) for text in _OF_GPU)
    return isinstance(error, torch.OutOfMemoryError) or said


# Matrix products of different shapes may sum in different orders: with a variable batch size, the
# last bits of an image's features would depend on the pieces in which results are told.  A single
# image costs as much as a full batch, so batches on a CPU are small.

_PIXELS = 2 * 112 * 112  # pixels of a batch on a CPU; larger batches are little faster
_ON_GPU = 64  # times as many pixels and images on a GPU
_MOST = 4  # most images of a batch on a CPU


def batch_size(device: torch.device, height: int, width: int) -> int:
    """Number of images of that size in a batch: on a CPU 2 images of 112 x 112."""
    more = 1 if device.type == "cpu" else _ON_GPU
    return min(max(more * _PIXELS // (height * width), 1), more * _MOST)


def in_batches(network: Callable[[Tensor], Tensor], images: Tensor, size: int) -> Tensor:
    """Results (n, ...) of a network for images (n, ...), in batches of exactly `size` images.

    The last batch is padded with zeros.
    """
    results = []
    for start in range(0, max(len(images), 1), size):
        piece = images[start : start + size]
        padding = piece.new_zeros(size - len(piece), *piece.shape[1:])
        padded = torch.cat([piece, padding]) if len(padding) else piece
        results.append(network(padded)[: len(piece)])
    return torch.cat(results)


def digest(*networks: nn.Module, extra: object = "") -> str:
    """Eight hexadecimal digits that identify the weights.

    extra: other settings that change the results, hashed as `str`.
    """
    sha = hashlib.sha256(str(extra).encode())
    for network in networks:
        for key, value in sorted(network.state_dict().items()):
            sha.update(key.encode())
            flat = value.detach().cpu().contiguous().reshape(-1)
            sha.update(flat.view(torch.uint8).numpy().tobytes())
    return sha.hexdigest()[:8]
