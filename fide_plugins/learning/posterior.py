"""What a search has of a learned model: hypotheses of the parameters of its picture."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.errors import ModelNotFoundError, OptionError
from fide_plugins.runtime.messages import warn_user
from fide_plugins.runtime.registry import changed, fingerprint_of, version_of
from fide_plugins.space import Space
from fide_plugins.types import Float64, Mask, Posterior

if TYPE_CHECKING:
    from fide_plugins.learning.model import Model

_DRAWN = 512
_DESCENTS = 16  # from hypotheses that were drawn, and as many from anywhere


def as_model(learned: Any) -> Model | None:
    """The model that `learned` is, or that its file has; OSError, CheckpointError, OptionError."""
    if learned is None:
        return None
    from fide_plugins.learning.model import Model  # takes a second: PyTorch's networks

    if isinstance(learned, str | os.PathLike):
        learned = Model.load(learned)
    if not isinstance(learned, Model):
        raise OptionError(f"learned is a model or its file, not {type(learned).__name__}")
    return learned


def posterior_of(
    learned: Model | None, space: Space | int, target: Any, seed: int
) -> Posterior | None:
    """Draw hypotheses of a target's parameters, and refine some where there is a good emulator.

    None without a model, and, with a warning, for a picture unlike all renders.  Raises OptionError
    for a model of another space or for several views, ImageError for another aspect.
    """
    if learned is None:
        return None
    learned.check_space(space)
    views = target if isinstance(target, list) else [target]
    if len(views) > 1:
        raise OptionError(
            f"a learned model knows one picture of each scene, and the target has {len(views)} "
            "views: leave out learned, or fit the view it was learned from alone"
        )
    (target,) = views
    far = learned.unfamiliarity(target)
    if far > 1:
        warn_user(
            f"the model of {learned.renderer!r} has learned nothing like this picture (its "
            f"features are {far:.3g} times as far from those of renders as the furthest that count "
            "as familiar): the search goes on without the model"
        )
        return None
    seed %= 2**32
    x = learned.sample(target, _DRAWN, seed)
    if learned.blocks:
        x[0] = _middle(x, np.array(learned.network.periodic))
    refined = None
    if learned.emulates:
        anywhere = np.random.default_rng((seed, 3)).random((_DESCENTS, learned.dim))
        refined = learned.refined(target, np.concatenate([x[:_DESCENTS], anywhere]), seed)
    return Posterior(x, refined)


def _middle(x: Float64, periodic: Mask) -> Float64:
    """Middle (d,) of sets (n, d) whose blocks come in one order: more exact than any of them."""
    turn = np.mod(np.angle(np.exp(2j * np.pi * x).mean(axis=0)) / (2 * np.pi), 1.0)
    return np.asarray(np.where(periodic, turn, np.median(x, axis=0)), np.float64)


def with_model(
    options: Mapping[str, Any], render: object, *, resumed: bool = False
) -> dict[str, Any]:
    """Options of a search of images by `render`, with a model in place of its file.

    resumed: whether a saved state has its hypotheses: the model is checked, and left out.
    Warns if the model is of another renderer; raises OptionError where they state different
    versions, OSError or CheckpointError for a file that is no model.
    """
    found, learned = dict(options), options.get("learned")
    if learned is None:
        return found
    from fide_plugins.learning.model import Model

    try:
        model = Model.load(learned) if isinstance(learned, str | os.PathLike) else learned
    except ModelNotFoundError as error:
        if not resumed:
            raise
        warn_user(f"{error}; the saved search has its hypotheses and goes on without the file")
    else:
        if isinstance(model, Model):
            _check_renderer(model, render)
        found["learned"] = model
    if resumed:
        del found["learned"]
    return found


def _check_renderer(model: Model, render: object) -> None:
    """Raise OptionError, or warn, unless the model is of this renderer."""
    here = version_of(render)
    if model.version is not None and here is not None:
        if model.version != here:
            raise OptionError(
                f"the model has learned version {model.version!r} of {model.renderer!r}, and the "
                f"renderer states version {here!r}: learn this version into another file, or leave "
                "out the model"
            )
    elif changed(model.fingerprint, fingerprint_of(render)):
        warn_user(
            f"the model has learned {model.renderer!r}, and that is not what renders here, or it "
            "was changed since; learn it again if its images are others now"
        )
