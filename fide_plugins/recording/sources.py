"""What a run depends on by name: versions are recorded, so that another one is noticed.

`run.json` has a digest of each file, of weights, and the version of each loss, the newest last.
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

_HYPOTHESES = "learned="  # option that names the file of a learned model
_ENCODER, _WEIGHTS = "encoder=", "weights"  # reference, and kind of the fingerprint
_LOSS, _VERSION = "loss=", "version"


def of_files(fingerprints: Mapping[str, str | None]) -> dict[str, str]:
    """Those fingerprints, by reference, that are of a file."""
    return {k: one for k, one in fingerprints.items() if one is not None and kind_of(one) == "file"}


def of_models(*options: Mapping[str, Any]) -> dict[str, str]:
    """Fingerprints of the files of learned models that options of optimizers name, by reference."""
    models = [one.get("learned") for one in options]
    files = sorted({os.fspath(one) for one in models if isinstance(one, str | os.PathLike)})
    return of_files({f"{_HYPOTHESES}{file}": of_file(file) for file in files})


def of_weights(optimizer: object) -> dict[str, str]:
    """Fingerprint of the pretrained weights that an optimizer's encoder has, by reference."""
    known = optimizer.pretrained if isinstance(optimizer, Saved) else None
    return {} if known is None else {f"{_ENCODER}{known[0]}": f"{_WEIGHTS}:{known[1]}"}


def of_losses(losses: Iterable[ImageLoss]) -> dict[str, str]:
    """Version of each loss that has one, by reference."""
    known = {one.name: one.version for one in losses if one.version is not None}
    return {f"{_LOSS}{name}": f"{_VERSION}:{version}" for name, version in known.items()}


def file_of(reference: str) -> str:
    """File or module of a reference, the network of an encoder, or a loss.

    >>> file_of("mine.py:Search"), file_of("learned=model.fide"), file_of("encoder=vgg19:relu4_1")
    ('mine.py', 'model.fide', 'the network of vgg19:relu4_1')
    """
    for prefix, what in ((_HYPOTHESES, ""), (_ENCODER, "the network of "), (_LOSS, "the loss ")):
        if reference.startswith(prefix):
            return what + reference.removeprefix(prefix)
    return reference.rpartition(":")[0] or reference


def versions_there(run: Mapping[str, Any] | None) -> dict[str, list[str]]:
    """Fingerprints in the contents of `run.json`, by reference, the newest last."""
    found = None if run is None else run.get("sources")
    return {
        reference: versions
        for reference, versions in (found.items() if isinstance(found, dict) else ())
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

    Warns, once for each edit, of a file or a loss that has changed since; but not of a model,
    weights or the loss of FIDE, whose state has or refuses them.
    """
    there = versions_there(before) if begun else {}
    if begun and before is not None:
        here = {name: now for name, now in here.items() if kind_of(now) != _WEIGHTS}
        if before["settings"].get("optimizer") == "fide":
            own = _LOSS + before["settings"].get("loss", "")
            here = {k: v for k, v in here.items() if k != own and not k.startswith(_HYPOTHESES)}
    newest = {reference: versions[-1:] for reference, versions in there.items()}
    for reference in edited(newest, here):
        warn_user(
            f"{file_of(reference)} has changed since the run in {path} was last at work: what is "
            "there was made with the earlier version, and what follows is with this one; unless "
            "the change only mends an error, undo it, or start again in another directory"
        )
    new = {name: now for name, now in here.items() if newest.get(name) != [now]}
    return there | {name: [*there.get(name, []), now] for name, now in new.items()}
