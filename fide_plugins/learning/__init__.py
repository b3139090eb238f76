"""Learn once what pictures say of a renderer's parameters, for every later picture.

Amortized inference: renders of random parameters train a network that maps an image to a density of
the parameters. For a new picture it gives several hypotheses at once, which the search then refines
(`FIDE(..., learned=model)`).

=================  =============================================================================
file               idea
=================  =============================================================================
`pipeline`         `learn`: its arguments are checked, and a plan is made of them
`plan`             how a model is made: renders, trainings, report
`model`            hypotheses, density, one file
`renderer`         a user's function, or a task
`store`            renders on disk, in shards
`identity`         whether what renders now is what rendered before
`made`             whether what was rendered can be learned from
`rendering`        fills the store, in one process or several, or on a cluster
`trainable`        what a network needs to be trained
`network`          encoder and head
`encoder`          a small convolutional network
`heads`            densities of the parameters: autoregressive, mixture
`head_choice`      which head, which blocks are exchangeable, whether there is an emulator
`sets`             exchangeable blocks as a set
`emulator`         a learned renderer of exchangeable blocks
`attention`        of these two networks
`inversion`        parameters of a picture, by descents through the emulator
`axes`             densities on one axis: truncated and wrapped Gaussians
`augmentation`     what separates a picture from a render
`training`         of network and emulator, judged on held-out renders
`resumable`        training that goes on from its checkpoint
`finishing`        a trained network is calibrated and judged
`calibration`      one scale for all standard deviations of a density, by held-out renders
`report`           how good a model is: likelihood, hypotheses, calibration
`seen`             which parameters images show
`familiarity`      how much a picture is like those that were learned
`hypotheses`       what the search is given
`truncation`       where a second round renders: the region of one picture's posterior
`rounds`           ``preset="global"``: two rounds, and then the search
=================  =============================================================================
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fide_plugins.learning.model import Model as Model
    from fide_plugins.learning.pipeline import learn as learn
    from fide_plugins.learning.plan import LearnProgress as LearnProgress
    from fide_plugins.learning.report import Report as Report

__all__ = ["LearnProgress", "Model", "Report", "learn"]

_ATTRIBUTES = {
    "LearnProgress": "plan",
    "Model": "model",
    "Report": "report",
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
