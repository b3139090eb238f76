"""Files of a DINO network: finds them, checks that they are complete, and reads its colors.

A network is a folder in the layout of the Hugging Face hub: ``config.json``, ``model.safetensors``
or several files of weights with an index, ``model.safetensors.index.json``, and
``preprocessor_config.json``.
"""

from __future__ import annotations

import json
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fide_plugins.encoders.pretrained.network import IMAGENET_MEAN, IMAGENET_STD
from fide_plugins.errors import DependencyError, WeightsMismatchError, WeightsNotFoundError
from fide_plugins.runtime.machine import missing as missing_extra
from fide_plugins.runtime.messages import warn_user

__all__ = ["DEFAULT", "colors", "find", "library", "missing", "read_json", "unreadable"]

DEFAULT = "facebook/dinov3-vits16-pretrain-lvd1689m"
_FILES = ["config.json", "preprocessor_config.json", "*.safetensors", "*.safetensors.index.json"]
_WEIGHTS = "model.safetensors"
_PHOTOGRAPHS = ("lvd", "dinov2")  # words in the names of networks with ImageNet's colors


def find(variant: str, download: bool) -> Path:
    """Folder with the network's files.

    variant: a folder, or a repository of the hub whose files must all be in the hub's cache.
    download: download missing files.

    Raises `WeightsNotFoundError`, and before it `DependencyError` without transformers.
    """
    if find_spec("transformers") is None:  # to import it takes seconds
        raise _not_installed()
    folder = Path(variant).expanduser()
    if variant and folder.is_dir():
        return folder
    hub = library("huggingface_hub")
    cached = None
    with suppress(ValueError):  # `variant` is not a valid name of a repository
        cached = hub.try_to_load_from_cache(variant, "config.json")
    absent = missing(Path(cached).parent) if isinstance(cached, str) else []
    if isinstance(cached, str) and not absent:
        return Path(cached).parent
    if not download:
        partly = f", but a part of it, without {', '.join(absent)}" if absent else ""
        raise WeightsNotFoundError(
            f"no folder {variant!r}, and no network of that name in {hub.constants.HF_HUB_CACHE}"
            f"{partly}; encoders.make('dinov3', download=True) fetches {DEFAULT} once (86 MB, "
            "after consent to its license on the hub and `hf auth login`), "
            "encoders.make('dinov3:FOLDER') reads a folder of yours, and the encoder 'dense' needs "
            "no weights"
        )
    try:
        return Path(hub.snapshot_download(variant, allow_patterns=_FILES))
    except Exception as error:  # no network, no such name, no consent: errors of many libraries
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise WeightsNotFoundError(
            f"no folder {variant!r}, and the hub did not give the network of that name ({reason})"
        ) from error


def missing(folder: Path) -> list[str]:
    """Names of missing files of weights, by the index if there is one.

    Raises `WeightsMismatchError` if the index is invalid.
    """
    index = folder / f"{_WEIGHTS}.index.json"
    if (folder / _WEIGHTS).is_file() or not index.is_file():
        return [] if (folder / _WEIGHTS).is_file() else [_WEIGHTS]
    files = read_json(index).get("weight_map")
    if not isinstance(files, dict) or not all(isinstance(name, str) for name in files.values()):
        raise WeightsMismatchError(f"{index}: weight_map must name a file for each key")
    return [name for name in sorted(set(files.values())) if not (folder / name).is_file()]


def colors(folder: Path, name: str) -> tuple[list[float], list[float]]:
    """Mean and standard deviation of colors that the network expects; ImageNet's by default.

    Warns about the default unless the name is that of a network trained on such colors.  Raises
    `WeightsMismatchError` unless the folder gives three numbers each.
    """
    path = folder / "preprocessor_config.json"
    stored = read_json(path) if path.is_file() else {}
    given = stored.get("image_mean", IMAGENET_MEAN), stored.get("image_std", IMAGENET_STD)
    try:
        mean, std = ([float(value) for value in color] for color in given)
    except (TypeError, ValueError):
        mean, std = [], []
    if len(mean) != 3 or len(std) != 3 or not all(0 < value < 10 for value in std):
        raise WeightsMismatchError(
            f"{path}: image_mean and image_std must be three numbers each, got {given!r}"
        )
    if not {"image_mean", "image_std"} <= stored.keys() and not any(
        word in name.lower() for word in _PHOTOGRAPHS
    ):
        warn_user(
            f"{path} does not say which image_mean and image_std the network {name!r} expects; "
            f"those of ImageNet are used, {list(IMAGENET_MEAN)} and {list(IMAGENET_STD)}, which "
            "are wrong for networks of satellite images, among others; get that file from the "
            "source of the weights"
        )
    return mean, std


def unreadable(folder: Path) -> Path | None:
    """The first file of weights with an invalid header or length; None if there is none."""
    from safetensors import SafetensorError, safe_open

    for path in sorted(folder.glob("*.safetensors")):
        try:
            with safe_open(path, "pt"):
                pass
        except (SafetensorError, OSError):
            return path
    return None


def read_json(path: Path) -> dict[str, Any]:
    """JSON object in a file; `WeightsMismatchError` if it holds none."""
    try:
        content = json.loads(path.read_text("utf-8"))
    except ValueError as error:
        raise WeightsMismatchError(f"{path} is not JSON ({error})") from error
    if not isinstance(content, dict):
        raise WeightsMismatchError(f"{path} must hold an object, got {type(content).__name__}")
    return content


def library(module: str = "transformers") -> Any:
    """A module of the extra `dinov3`; `DependencyError` if it is not installed."""
    try:
        return import_module(module)
    except ImportError as error:
        raise _not_installed() from error


def _not_installed() -> DependencyError:
    return missing_extra("dinov3", "the encoder 'dinov3' needs transformers")
