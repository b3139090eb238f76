"""Precision of the network's products; its weights are always float32."""

from __future__ import annotations

from contextlib import AbstractContextManager

import torch

from fide_plugins.errors import OptionError
from fide_plugins.runtime.devices import has_bfloat16
from fide_plugins.runtime.messages import warn_user

__all__ = ["PRECISIONS", "autocast", "check_precision"]

PRECISIONS = ("float32", "bfloat16")


def check_precision(precision: str, device: torch.device) -> str:
    """Precision for the device: float32, with a RuntimeWarning, if it does not support bfloat16.

    Raises OptionError for a name that is not in `PRECISIONS`.
    """
    if precision not in PRECISIONS:
        raise OptionError(f"precision must be one of {', '.join(PRECISIONS)}, not {precision!r}")
    if precision == "bfloat16" and not has_bfloat16(device):
        warn_user(
            f"this {device.type} does not support precision='bfloat16' in hardware; float32 is "
            "used instead"
        )
        return "float32"
    return precision


def autocast(precision: str, device: torch.device) -> AbstractContextManager[object]:
    """Context that computes products in this precision, and sensitive sums in float32.

    It does not depend on the autocast state of the calling thread, which other threads do not
    share.  It caches no copies of weights, which would outlive a training step in an outer block.
    """
    low = precision == "bfloat16"
    return torch.autocast(device.type, torch.bfloat16, enabled=low, cache_enabled=False)
