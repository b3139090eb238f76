"""Learn once what pictures say of a renderer's parameters, for every later picture.

Renders of random parameters train a network that maps an image to a density of the parameters; for
a new picture it gives several hypotheses at once, which a search refines (`learned=model`).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fide_plugins.learning.judging import Report as Report
    from fide_plugins.learning.model import Model as Model
    from fide_plugins.learning.pipeline import LearnProgress as LearnProgress, learn as learn

_PLACES = {"LearnProgress": "pipeline", "Model": "model", "Report": "judging", "learn": "pipeline"}
__all__ = ["LearnProgress", "Model", "Report", "learn"]

if not TYPE_CHECKING:  # a process that renders needs no PyTorch

    def __getattr__(name: str) -> Any:
        """Import `name` the first time somebody asks for it (PEP 562)."""
        if name not in _PLACES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
        globals()[name] = value
        return value
