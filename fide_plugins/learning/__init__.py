"""Learn once what pictures say of a renderer's parameters, for every later picture.

Amortized inference: renders of random parameters train a network that maps an image to a density of
the parameters. For a new picture it gives several hypotheses at once, which the search then refines
(`FIDE(..., learned=model)`).

============  ==================================================================================
file          idea
============  ==================================================================================
`pipeline`    `learn`: its arguments are checked, and a plan is made of them
`plan`        how a model is made: renders, trainings, report
`renders`     renders of random parameters: made, kept on disk, checked
`networks`    encoder, densities of the parameters, a learned renderer
`training`    of a network, judged on held-out renders; it goes on from its checkpoint
`judging`     a trained network is calibrated and measured
`model`       hypotheses, density, one file
`hypotheses`  what the search is given
`truncation`  where a second round renders: the region of one picture's posterior
`rounds`      ``preset="global"``: two rounds, and then the search
============  ==================================================================================
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fide_plugins.learning.judging.report import Report as Report
    from fide_plugins.learning.model import Model as Model
    from fide_plugins.learning.pipeline import learn as learn
    from fide_plugins.learning.plan import LearnProgress as LearnProgress

__all__ = ["LearnProgress", "Model", "Report", "learn"]

_ATTRIBUTES = {
    "LearnProgress": "plan",
    "Model": "model",
    "Report": "judging.report",
    "learn": "pipeline",
}


if not TYPE_CHECKING:  # a process that renders needs no PyTorch

    def __getattr__(name: str) -> Any:
        """Import the class or function `name` the first time somebody asks for it (PEP 562)."""
        if name not in _ATTRIBUTES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"{__name__}.{_ATTRIBUTES[name]}"), name)
        globals()[name] = value
        return value
