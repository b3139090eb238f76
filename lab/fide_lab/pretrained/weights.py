"""Finds, reads and checks files of network weights.

Only ``download=True`` downloads anything.  PyTorch reads files with ``weights_only=True``: they
run no code.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from fide_plugins.errors import WeightsMismatchError, WeightsNotFoundError


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
        """Path of the weights: the user's file, or else the first existing one.

        others: places to search before PyTorch's cache.
        download: whether the file is fetched into that cache if it is nowhere.
        how: other ways to get the weights, as the end of the error message.

        Raises WeightsNotFoundError, which names the places, or says why a download failed.
        """
        places = [*others, self.cached] if given is None else [Path(given)]
        for path in places:
            if path.is_file():
                return path
        if not download or given is not None:
            looked = " or ".join(str(path) for path in places)
            raise WeightsNotFoundError(f"no weights of {self.network} at {looked}{how}")
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

    Raises WeightsNotFoundError, and WeightsMismatchError for a file that is cut short, damaged or
    holds anything but tensors.
    """
    if not path.is_file():
        raise WeightsNotFoundError(f"no file of weights at {path}")
    try:
        state: Any = torch.load(path, map_location="cpu", weights_only=True)
    except OSError:
        raise
    except Exception as error:  # readers of untrusted bytes raise nearly anything
        raise WeightsMismatchError(
            f"{path} is cut short, damaged, or holds more than tensors ({type(error).__name__}); "
            "get it again"
        ) from error
    if not isinstance(state, Mapping) or not all(
        isinstance(k, str) and isinstance(v, Tensor) for k, v in state.items()
    ):
        raise WeightsMismatchError(
            f"{path} must hold tensors by name, a state dict, and holds {type(state).__name__}"
        )
    return dict(state)


def fill(
    network: nn.Module, state: Mapping[str, Tensor], path: Path, *, ignored: tuple[str, ...] = ()
) -> None:
    """Load the tensors of `state`, which was read from `path`, into the network as float32.

    ignored: prefixes of keys that are not used.

    Raises WeightsMismatchError, which names the file, if keys are missing or unknown, or tensors
    have another shape or values that are not finite.
    """
    used = {key: value for key, value in state.items() if not key.startswith(ignored)}
    copies = {key: value.to(torch.float32, copy=True) for key, value in used.items()}
    try:
        network.load_state_dict(copies, assign=True)
    except RuntimeError as error:
        raise WeightsMismatchError(f"{path} belongs to another network: {error}") from error
    check_finite(copies, path)
    network.eval().requires_grad_(False)


def check_finite(state: Mapping[str, Tensor], path: Path) -> None:
    """Raise WeightsMismatchError for the first tensor that has NaN or infinity."""
    for key, value in state.items():
        if not torch.isfinite(value).all():
            raise WeightsMismatchError(f"{path}: {key!r} has values that are not finite")
