"""What a sampler refuses, and warns of, in the studies and trials that it is given."""

from __future__ import annotations

import math
from collections.abc import Mapping
from inspect import currentframe
from types import FrameType
from typing import Any

from optuna.distributions import BaseDistribution
from optuna.study import Study, StudyDirection
from optuna.trial import FixedTrial, FrozenTrial, Trial

from fide_adapters.image_loss import is_image
from fide_adapters.optuna.storage import WarnOnce
from fide_plugins.errors import OptionError, ProtocolError

__all__ = [
    "as_constraints",
    "check_function",
    "refuse_several_objectives",
    "running_trial",
    "warn_of_bare_image",
    "warn_of_space",
]


def check_function(name: str, function: Any) -> Any:
    """Return a function, or None; raises OptionError (a ValueError) for anything else."""
    if function is not None and not callable(function):
        raise OptionError(f"{name} must be a function of a trial, not {function!r}")
    return function


def as_constraints(values: Any) -> list[float]:
    """What a `constraints_func` has returned, as it is stored; raises OptionError."""
    try:
        numbers = [float(value) for value in values]
    except (TypeError, ValueError):
        numbers = [math.nan]
    if any(map(math.isnan, numbers)):
        raise OptionError(
            "constraints_func must return a list of numbers, <= 0 where nothing is violated, not "
            f"{values!r}"
        )
    return numbers


def warn_of_bare_image(warnings: WarnOnce) -> None:
    """Warn if the objective of a trial that fails now has returned an image.

    That is an array of two or more axes, alone or in a pair (loss, image); Optuna itself reports
    anything else.  Optuna tells a sampler that a trial failed, but not with which value.  The value
    is a local variable of the function of Optuna that calls the sampler; nothing is said where it
    is not found.  An error would be lost: Optuna replaces those of a trial that has failed.
    """
    frame: FrameType | None = currentframe()
    while frame is not None and frame.f_code.co_name != "_tell_with_warning":
        frame = frame.f_back
    value: Any = None if frame is None else frame.f_locals.get("value_or_values")
    pair = isinstance(value, tuple) and len(value) == 2
    image = value[1] if pair else value
    if not (is_image(image) and hasattr(image, "ndim")):
        return
    what = "a pair (loss, image), the image" if pair else "an image,"
    warnings.warn(
        "bare image",
        f"the objective returned {what} a {type(image).__name__} of shape {tuple(image.shape)}, "
        "where Optuna takes a loss, so its trials fail; wrap it: "
        "study.optimize(image_objective(objective)), with image_objective of "
        "fide_adapters.optuna, or return sampler.tell_image(trial, image)",
    )


def refuse_several_objectives(study: Study) -> None:
    """Raise OptionError, a ValueError, if the study has more than one objective."""
    if len(study.directions) > 1:
        raise OptionError(
            f"FIDESampler cannot be used in a study of {len(study.directions)} objectives: an "
            "image has one loss; create the study with one direction"
        )


def running_trial(trial: object, own_loss: bool) -> Trial | None:
    """Trial of an objective, to record an image in; None for one in which nothing is recorded.

    own_loss: whether the loss is the sampler's own, which must be minimized.

    Raises OptionError, a ValueError, if the study has several objectives, and ProtocolError for
    whatever is no trial, or maximizes the sampler's own loss.
    """
    if isinstance(trial, FrozenTrial | FixedTrial):
        return None
    if not isinstance(trial, Trial):
        raise ProtocolError(
            "the image is recorded in the optuna.Trial that the objective is given or study.ask "
            f"returns, not in an object of type {type(trial).__name__}; give that trial itself, "
            "also where another object wraps it"
        )
    refuse_several_objectives(trial.study)
    if own_loss and trial.study.direction is StudyDirection.MAXIMIZE:
        raise ProtocolError(
            "the sampler's own loss must be minimized, but the study maximizes; give a loss, "
            "or create the study with direction='minimize'"
        )
    return trial


def warn_of_space(
    space: Mapping[str, BaseDistribution], trial: FrozenTrial, warnings: WarnOnce
) -> None:
    """Warn of a completed trial that does not have the parameters of `space` as they are there."""
    missing = space.keys() - trial.params.keys()
    if missing:
        warnings.warn(
            "search_space",
            f"trial {trial.number} has no {', '.join(sorted(missing))}, which search_space "
            "names, so it is left out; name only parameters that every trial has",
        )
    for name in space.keys() - missing:
        given, own = space[name], trial.distributions[name]
        if given != own:
            warnings.warn(
                "distribution",
                f"the objective suggests {name!r} from {own}, but search_space has {given}: the "
                "search goes by search_space and covers only what is in both; make them equal",
            )
