"""Learn once what pictures say of a renderer's parameters, for every later picture.

Amortized inference: renders of random parameters train a network that maps an image to a density of
the parameters.  For a new picture it gives several hypotheses at once, which the search refines
(`FIDE(..., learned=model)`).

==============  ================================================================================
file            idea
==============  ================================================================================
`pipeline`      `learn`: renders, trainings and report; a second round for one picture
`renders`       a renderer, and its images of random parameters on disk
`rendering`     fills that store: in this process, in others, on a cluster
`networks`      encoder, densities of the parameters
`emulator`      a learned renderer, and descents through it
`training`      of a network on renders; it goes on from its checkpoint
`augmentation`  how renders are changed meanwhile
`clutter`       backgrounds, occluders and shadows for renders that say what they cover
`judging`       a trained network is calibrated and measured
`model`         hypotheses, density, one file
`hypotheses`    what a search is given of it
==============  ================================================================================
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
        """Import the class or function `name` the first time somebody asks for it (PEP 562)."""
        if name not in _PLACES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
        globals()[name] = value
        return value
