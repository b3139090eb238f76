"""Other optimizers with the ask/tell protocol of FIDE, for comparison.

    >>> from fide_lab import baselines
    >>> opt = baselines.CMA(dim=3, seed=0)
    >>> X = opt.ask()
    >>> opt.tell(X, losses=((X - 0.3) ** 2).sum(1))
    >>> opt.evaluations
    7

Nothing is imported before it is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

PLACES: Mapping[str, str] = {
    "cma": "fide_lab.baselines.evolution:CMA",
    "dfols": "fide_lab.baselines.libraries:DFOLS",
    "dibo": "fide_lab.baselines.dibo:DiBO",
    "diffusion-evolution": "fide_lab.baselines.evolution:DiffusionEvolution",
    "dual-annealing": "fide_lab.baselines.libraries:DualAnnealing",
    "eki": "fide_lab.baselines.image_based:EKI",
    "fide-annealing": "fide_lab.baselines.image_based:FIDEAnnealing",
    "inverse": "fide_lab.baselines.image_based:Inverse",
    "random": "fide_lab.baselines.evolution:Random",
    "sge": "fide_lab.baselines.sge:SGE",
    "zerograds": "fide_lab.baselines.zerograds:ZeroGrads",
}
"""Where the classes of ours are."""
FAMILIES = ("nevergrad", "optuna")
"""First words of ``"FAMILY:NAME"``; functions of `libraries`, which make classes."""
_PLACES = [
    f"{__name__}.base:Baseline",
    *PLACES.values(),
    *(f"{__name__}.libraries:{family}" for family in FAMILIES),
]
_MODULES = {name: module for module, _, name in (place.partition(":") for place in _PLACES)}

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    """Import a baseline the first time somebody asks for it."""
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Names of everything here, loaded or not."""
    return sorted({*globals(), *__all__})
