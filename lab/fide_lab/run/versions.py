"""Versions of what a run depends on beside the user's files: models, pretrained weights, losses."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Any

from fide_plugins.losses.base import ImageLoss
from fide_plugins.recording.directory import of_files
from fide_plugins.runtime.registry import kind_of, of_file
from fide_plugins.saving import Saved

_MODEL, _LOSS = "learned=", "loss="
_WEIGHTS = "weights"


def of_models(*options: Mapping[str, Any]) -> dict[str, str]:
    """Fingerprints of the files of learned models that options of optimizers name, by reference."""
    models = [one.get("learned") for one in options]
    files = sorted({os.fspath(one) for one in models if isinstance(one, str | os.PathLike)})
    return of_files({f"{_MODEL}{file}": of_file(file) for file in files})


def of_weights(optimizer: object) -> dict[str, str]:
    """Fingerprint of the pretrained weights that an optimizer's encoder has, by reference."""
    known = optimizer.pretrained if isinstance(optimizer, Saved) else None
    return {} if known is None else {f"encoder={known[0]}": f"{_WEIGHTS}:{known[1]}"}


def of_losses(losses: Iterable[ImageLoss]) -> dict[str, str]:
    """Version of each loss that has one, by reference."""
    known = {one.name: one.version for one in losses if one.version is not None}
    return {f"{_LOSS}{name}": f"version:{version}" for name, version in known.items()}


def that_count_later(
    versions: Mapping[str, str], of_fide: bool, loss: str, resumed: bool
) -> dict[str, str]:
    """Those that a run which goes on depends on: its state has weights, and FIDE's model and loss.

    loss: name of the optimizer's.  resumed: whether it goes on; else all of them count.
    """
    if not resumed:
        return dict(versions)
    found = {name: now for name, now in versions.items() if kind_of(now) != _WEIGHTS}
    if not of_fide:
        return found
    return {k: v for k, v in found.items() if k != _LOSS + loss and not k.startswith(_MODEL)}
