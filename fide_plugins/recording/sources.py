"""What a run depends on by name: versions are recorded, so that another one is noticed.

A reference such as ``mine.py:Search`` or ``learned=model.fide`` is all that the settings of a run
have of them.  `run.json` has the digest of each file beside it, of the weights of a pretrained
encoder, and the version of each loss, one for each version that calls of the run have had.  What a
file imports is not known.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fide_plugins.runtime.messages import warn_user
from fide_plugins.runtime.registry import changed, kind_of, of_file
from fide_plugins.saving import Saved

if TYPE_CHECKING:
    from fide_plugins.losses.base import ImageLoss

__all__ = [
    "edited",
    "file_of",
    "loss_reference",
    "of_files",
    "of_losses",
    "of_models",
    "of_weights",
    "versions_there",
    "versions_with",
    "warn_of_model",
    "with_model_there",
]

_HYPOTHESES = "learned="  # option that names the file of a learned model
_ENCODER, _WEIGHTS = "encoder=", "weights"  # reference, and kind of the fingerprint
_LOSS, _VERSION = "loss=", "version"
_OBJECT = "Model"  # in the settings, for a model that was given as an object


def of_files(fingerprints: Mapping[str, str | None]) -> dict[str, str]:
    """Those fingerprints, by reference, that are of a file."""
    found = {name: one for name, one in fingerprints.items() if one is not None}
    return {name: one for name, one in found.items() if kind_of(one) == "file"}


def of_models(*options: Mapping[str, Any]) -> dict[str, str]:
    """Fingerprints of the files of learned models that options of optimizers name, by reference."""
    named = {
        f"{name}={os.fspath(value)}"
        for given in options
        for name, value in given.items()
        if isinstance(value, str | os.PathLike)
    }
    models = [reference for reference in sorted(named) if reference.startswith(_HYPOTHESES)]
    return of_files({reference: of_file(file_of(reference)) for reference in models})


def of_weights(optimizer: object) -> dict[str, str]:
    """Fingerprint of the pretrained weights that an optimizer's encoder has, by reference."""
    known = optimizer.pretrained if isinstance(optimizer, Saved) else None
    return {} if known is None else {f"{_ENCODER}{known[0]}": f"{_WEIGHTS}:{known[1]}"}


def of_losses(losses: Iterable[ImageLoss]) -> dict[str, str]:
    """Version of each loss that has one, by reference."""
    return {
        loss_reference(one.name): f"{_VERSION}:{one.version}"
        for one in losses
        if one.version is not None
    }


def loss_reference(name: str) -> str:
    """Reference of the loss of that name."""
    return f"{_LOSS}{name}"


def file_of(reference: str) -> str:
    """File or module of a reference, the network of an encoder, or a loss.

    >>> file_of("mine.py:Search"), file_of("learned=model.fide")
    ('mine.py', 'model.fide')
    >>> file_of("encoder=vgg19:relu4_1")
    'the network of vgg19:relu4_1'
    """
    if reference.startswith(_HYPOTHESES):
        return reference.removeprefix(_HYPOTHESES)
    if reference.startswith(_ENCODER):
        return f"the network of {reference.removeprefix(_ENCODER)}"
    if reference.startswith(_LOSS):
        return f"the loss {reference.removeprefix(_LOSS)}"
    return reference.rpartition(":")[0] or reference


def versions_there(run: Mapping[str, Any] | None) -> dict[str, list[str]]:
    """Fingerprints in the contents of `run.json`, by reference, the newest last.

    Empty where there are none: without such a file, and in one of an earlier version.
    """
    found = None if run is None else run.get("sources")
    if not isinstance(found, dict):
        return {}
    return {
        reference: versions
        for reference, versions in found.items()
        if isinstance(versions, list) and versions and all(isinstance(v, str) for v in versions)
    }


def edited(there: Mapping[str, list[str]], here: Mapping[str, str]) -> list[str]:
    """References to files of which a run has had another version than the present one."""
    return [
        reference
        for reference, now in here.items()
        if any(changed(before, now) for before in there.get(reference, []))
    ]


def versions_with(
    here: Mapping[str, str], before: Mapping[str, Any] | None, path: Path, *, begun: bool
) -> dict[str, list[str]]:
    """Fingerprints to record when the run in the folder `path` is begun or resumed.

    before: contents of its `run.json`, if there is one; begun: whether it goes on from a saved
        state, which is of the versions before.

    Warns, once for each edit, of a file or a loss that has changed since, but of no model and no
    loss of FIDE: the model of its hypotheses is not read again (`warn_of_model`), and it refuses
    another encoder or loss, as every encoder refuses other weights.
    """
    there = versions_there(before) if begun else {}
    if begun:
        here = {name: now for name, now in here.items() if kind_of(now) != _WEIGHTS}
    if begun and before is not None and before["settings"].get("optimizer") == "fide":
        here = {name: now for name, now in here.items() if not name.startswith(_HYPOTHESES)}
        here.pop(loss_reference(before["settings"].get("loss", "")), None)
    newest = {reference: versions[-1:] for reference, versions in there.items()}
    for reference in edited(newest, here):
        file = file_of(reference)
        warn_user(
            f"{file} has changed since the run in {path} was last at work: what is there was made "
            "with the earlier version, and what follows is with this one; unless the change only "
            "mends an error, undo it, or start again in another directory"
        )
    return {
        **there,
        **{
            reference: [*there.get(reference, []), now]
            for reference, now in here.items()
            if newest.get(reference) != [now]
        },
    }


def with_model_there(there: Mapping[str, Any], here: dict[str, Any]) -> dict[str, Any]:
    """Settings of a fit that goes on from its saved state, with the model that it began with.

    The state has that model's hypotheses, and the file may be anywhere now.
    there, here: settings that are saved, and those of this call.  Others than FIDE need their
        model.
    """
    before = _learned(there)
    if here.get("optimizer") != "fide" or before is None or before == _learned(here):
        return here
    return {**here, "options": {**here["options"], "learned": before}}


def warn_of_model(
    given: Mapping[str, Any], run: Mapping[str, Any], here: Mapping[str, str], path: Path
) -> None:
    """Warn of a model file that is given, where the search in the folder `path` has another one.

    Others than FIDE read their model again, see `versions_with`.
    given: settings of this call; run: contents of `run.json` of a fit that goes on from its saved
        state; here: fingerprints of this call.
    """
    if given.get("optimizer") != "fide":
        return
    now, before = _learned(given), _learned(run["settings"])
    if now in (None, _OBJECT) or before in (None, _OBJECT):  # no file, or it is not known which
        return
    renamed = Path(str(now)).absolute() != Path(str(before)).absolute()
    then = versions_there(run).get(f"{_HYPOTHESES}{before}")
    present = here.get(f"{_HYPOTHESES}{now}")
    another = then[-1] != present if then and present else renamed
    if another:
        warn_user(
            f"the search in {path} goes on with the hypotheses of {before}, with which it began: "
            f"learned={now!r} {'' if renamed else 'has changed since and '}is not used; to use it, "
            "start again in another directory"
        )


def _learned(settings: Mapping[str, Any]) -> Any:
    options = settings.get("options")
    return options.get("learned") if isinstance(options, dict) else None
