"""Rivals behind the same ask/tell protocol as FIDE.

    >>> from fide_plugins import baselines
    >>> opt = baselines.CMA(dim=3, seed=0)
    >>> X = opt.ask()
    >>> opt.tell(X, losses=((X - 0.3) ** 2).sum(1))
    >>> opt.evaluations
    7

Nothing is imported before it is used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fide_plugins.baselines.base import Baseline as Baseline
    from fide_plugins.baselines.cma import CMA as CMA
    from fide_plugins.baselines.random import Random as Random

__all__ = ["CMA", "Baseline", "Random"]

_MODULES = {"Baseline": "base", "CMA": "cma", "Random": "random"}

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Import a baseline the first time somebody asks for it."""
        if name in _MODULES:
            return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Names of everything here, loaded or not."""
    return sorted({*globals(), *__all__})
