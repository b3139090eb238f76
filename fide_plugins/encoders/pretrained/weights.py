"""Finds, reads and checks files of network weights.

Only ``download=True`` downloads anything.  safetensors reads a file whose name ends in
``.safetensors``; PyTorch reads other files with ``weights_only=True``, which refuses pickles of
anything but tensors and runs no code.
"""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from fide_plugins.errors import WeightsMismatchError, WeightsNotFoundError
from fide_plugins.runtime.machine import missing

__all__ = ["Published", "check_finite", "fill", "read"]


@dataclass(frozen=True, slots=True)
class Published:
    """Published weights.

    network: name of the network, for messages.
    file: torchvision's name of the file in PyTorch's cache.
    url: its address.
    sha256: first digits of the file's SHA-256.
    """

    network: str
    file: str
    url: str
    sha256: str

    @property
    def cached(self) -> Path:
        """Path of the file in PyTorch's cache; ``TORCH_HOME`` moves the cache."""
        return Path(torch.hub.get_dir(), "checkpoints", self.file)

    def find(
        self,
        given: str | os.PathLike[str] | None = None,
        *,
        others: Iterable[Path] = (),
        download: bool = False,
        how: str = "",
    ) -> Path:
        """Path of the weights: the given file, or else the first existing one.

        Parameters
        ----------
        given
            file of the user.
        others
            further places to search before PyTorch's cache.
        download
            download the file into that cache if it is nowhere.
        how
            other ways to get the weights, as the end of the error message.

        Raises
        ------
        WeightsNotFoundError
            the file is missing; the message names the places.
        """
        places = [*others, self.cached] if given is None else [Path(given)]
        for path in places:
            if path.is_file():
                return path
        if download and given is None:
            return self._download()
        looked = " or ".join(str(path) for path in places)
        raise WeightsNotFoundError(f"no weights of {self.network} at {looked}{how}")

    def _download(self) -> Path:
        self.cached.parent.mkdir(parents=True, exist_ok=True)
        try:
            torch.hub.download_url_to_file(self.url, str(self.cached), self.sha256, progress=True)
        except (OSError, RuntimeError) as error:  # no network connection; wrong checksum
            raise WeightsNotFoundError(
                f"{self.network}: {self.url} could not be downloaded to {self.cached} ({error})"
            ) from error
        return self.cached


def read(path: Path) -> dict[str, Tensor]:
    """Tensors of a file by name, on the CPU.

    Raises
    ------
    WeightsNotFoundError
        there is no such file.
    WeightsMismatchError
        it is truncated, damaged, or holds anything but tensors.
    DependencyError
        it is in the safetensors format, and that package is not installed.
    """
    try:
        state = _read_safetensors(path) if path.suffix == ".safetensors" else _read_torch(path)
    except FileNotFoundError as error:
        raise WeightsNotFoundError(f"no file of weights at {path}") from error
    except (OSError, ImportError):
        raise
    except Exception as error:  # readers of untrusted bytes raise nearly anything
        raise WeightsMismatchError(
            f"{path} is cut short, damaged, or holds more than tensors ({_reason(error)}); get it "
            "again"
        ) from error
    if not isinstance(state, Mapping) or not all(
        isinstance(k, str) and isinstance(v, Tensor) for k, v in state.items()
    ):
        raise WeightsMismatchError(
            f"{path} must hold tensors by name, a state dict, and holds {type(state).__name__}"
        )
    return dict(state)


def _reason(error: Exception) -> str:
    """Reason of an error in one line, without PyTorch's advice to run the code in the file."""
    refused = re.search(r"GLOBAL [\w.]+|Unsupported operand \d+", str(error))
    first = (str(error).splitlines() or [""])[0]
    if refused:
        return refused[0].replace("GLOBAL", "it refers to").replace("Unsupported", "unknown")
    return first if first and "weights_only" not in first else type(error).__name__


def _read_safetensors(path: Path) -> Any:
    try:
        from safetensors.torch import load_file
    except ImportError as error:
        what = f"reading {path.name} needs safetensors"
        raise missing("dinov3", what, "safetensors") from error
    return load_file(path)


def _read_torch(path: Path) -> Any:
    mapped = zipfile.is_zipfile(path)  # reads only the used parts; impossible for older files
    return torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)


def fill(
    network: nn.Module, state: Mapping[str, Tensor], path: Path, *, ignored: tuple[str, ...] = ()
) -> None:
    """Load the tensors of `state`, which was read from `path`, into the network as float32.

    ignored: prefixes of keys that are not used.

    Raises
    ------
    WeightsMismatchError
        a key is missing or unknown, or its tensor has another shape or values that are not finite;
        the message names file, key and shape.
    """
    expected = network.state_dict()
    for key, own in expected.items():
        if key not in state:
            raise WeightsMismatchError(
                f"{path} has no {key!r}, of shape {tuple(own.shape)}: it belongs to another network"
            )
        if state[key].shape != own.shape:
            raise WeightsMismatchError(
                f"{path}: {key!r} has the shape {tuple(state[key].shape)}, and must have "
                f"{tuple(own.shape)}: it belongs to another network"
            )
    for key, other in state.items():
        if key not in expected and not key.startswith(ignored):
            raise WeightsMismatchError(
                f"{path} has {key!r}, of shape {tuple(other.shape)}, which this network does not "
                "have: it belongs to another network"
            )
    check_finite(state, path, expected)
    copies = {key: state[key].to(torch.float32, copy=True) for key in expected}
    network.load_state_dict(copies, assign=True)
    network.eval().requires_grad_(False)


def check_finite(state: Mapping[str, Tensor], path: Path, keys: Iterable[str]) -> None:
    """Raise `WeightsMismatchError` for the first of the keys whose tensor has NaN or infinity."""
    for key in keys:
        if not torch.isfinite(state[key]).all():
            raise WeightsMismatchError(
                f"{path}: {key!r}, of shape {tuple(state[key].shape)}, has values that are not "
                "finite"
            )
