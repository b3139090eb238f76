"""Other optimizers with the ask/tell protocol of FIDE, for comparison.

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

from fide_plugins.optimizers import FAMILIES, PLACES

if TYPE_CHECKING:
    from fide_plugins.baselines.base import Baseline as Baseline
    from fide_plugins.baselines.bipop import BIPOP as BIPOP
    from fide_plugins.baselines.cma import CMA as CMA
    from fide_plugins.baselines.dfols import DFOLS as DFOLS
    from fide_plugins.baselines.dibo import DiBO as DiBO
    from fide_plugins.baselines.dual_annealing import DualAnnealing as DualAnnealing
    from fide_plugins.baselines.eki import EKI as EKI
    from fide_plugins.baselines.fide_annealing import FIDEAnnealing as FIDEAnnealing
    from fide_plugins.baselines.frameworks import nevergrad as nevergrad, optuna as optuna
    from fide_plugins.baselines.inverse import Inverse as Inverse
    from fide_plugins.baselines.lq_cma import LQCMA as LQCMA
    from fide_plugins.baselines.npe.search import NPE as NPE
    from fide_plugins.baselines.pgpe import PGPE as PGPE
    from fide_plugins.baselines.random import Random as Random
    from fide_plugins.baselines.trust_region.composite import CompositeBO as CompositeBO
    from fide_plugins.baselines.trust_region.turbo import TuRBO as TuRBO
    from fide_plugins.baselines.zerograds import ZeroGrads as ZeroGrads

_PLACES = [
    f"{__name__}.base:Baseline",
    *(place for place in PLACES.values() if place.startswith(f"{__name__}.")),
    *(f"{__name__}.frameworks:{family}" for family in FAMILIES),
]
_MODULES = {name: module for module, _, name in (place.partition(":") for place in _PLACES)}

__all__ = sorted(_MODULES)

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Import a baseline the first time somebody asks for it."""
        if name in _MODULES:
            return getattr(import_module(_MODULES[name]), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Names of everything here, loaded or not."""
    return sorted({*globals(), *__all__})
