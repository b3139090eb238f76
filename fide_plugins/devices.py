"""Which device computes."""

from __future__ import annotations

import torch

from fide_plugins.errors import DeviceError

__all__ = ["resolve_device"]


def resolve_device(device: str | torch.device = "auto") -> torch.device:
    """Device of that name; ``"auto"`` is the first CUDA device, or the CPU where there is none.

    Raises
    ------
    DeviceError
        the name is none that torch knows, or this machine has no such device.
    """
    if isinstance(device, str) and device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        resolved = torch.device(device)
        torch.empty(0, device=resolved)
    except (RuntimeError, AssertionError, TypeError, NotImplementedError) as e:
        reason = str(e).splitlines()[0]
        raise DeviceError(f"no device {device!r} here ({reason}); 'auto' or 'cpu' works") from e
    return resolved
