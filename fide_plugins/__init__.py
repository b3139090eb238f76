"""FIDE: fit a black-box renderer to a picture.

    from fide_plugins import FIDE, encoders, fit, losses

Everything here is loaded when it is first used, so that importing the package takes milliseconds
and loads no PyTorch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fide_adapters.optuna import FIDESampler as FIDESampler
    from fide_lab import (
        baselines as baselines,
        compare as compare,
        optimizers as optimizers,
        report as report,
        run as harness,  # noqa: F401  in `__all__`
    )

    from . import encoders as encoders, errors as errors, losses as losses
    from .errors import WeightsNotFoundError as WeightsNotFoundError
    from .fide import FIDE as FIDE
    from .fitting.fidelity import Fidelity as Fidelity
    from .fitting.one_call import fit as fit
    from .fitting.result import Result as Result
    from .fitting.saved_run import load_run as load_run
    from .learning import learn as learn
    from .runtime import checkpoint as checkpoint
    from .space import (
        Choice as Choice,
        Float as Float,
        Group as Group,
        Int as Int,
        Space as Space,
    )
    from .types import Solution as Solution
    from .validation import images as images

__version__ = "1.0.0rc1"

_SUBMODULES = {
    "checkpoint": ".runtime.checkpoint",
    "encoders": ".encoders",
    "errors": ".errors",
    "images": ".validation.images",
    "losses": ".losses",
}
_LABORATORY = {
    "baselines": "baselines",
    "compare": "compare",
    "harness": "run",
    "optimizers": "optimizers",
    "report": "report",
}
"""Names of 0.2, and what they are in `fide_lab`."""
_ATTRIBUTES = {
    "Choice": ".space",
    "FIDE": ".fide",
    "FIDESampler": "fide_adapters.optuna",  # needs Optuna, so it is not in __all__
    "Fidelity": ".fitting.fidelity",
    "Float": ".space",
    "Group": ".space",
    "Int": ".space",
    "Result": ".fitting.result",
    "Solution": ".types",
    "Space": ".space",
    "WeightsNotFoundError": ".errors",
    "fit": ".fitting.one_call",
    "learn": ".learning",
    "load_run": ".fitting.saved_run",
}

__all__ = sorted({"__version__", *_SUBMODULES, *_LABORATORY, *_ATTRIBUTES} - {"FIDESampler"})


if not TYPE_CHECKING:  # a type checker would take every name for one that exists

    def __getattr__(name: str) -> Any:
        """Import the submodule or class `name` the first time somebody asks for it (PEP 562)."""
        if name in _SUBMODULES:
            return import_module(_SUBMODULES[name], __name__)
        if name in _LABORATORY:
            return import_module(".runtime.laboratory", __name__).module(_LABORATORY[name])
        if name in _ATTRIBUTES:
            value = getattr(import_module(_ATTRIBUTES[name], __name__), name)
            globals()[name] = value
            return value
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Public names, loaded or not."""
    return sorted({*__all__, *_ATTRIBUTES})
