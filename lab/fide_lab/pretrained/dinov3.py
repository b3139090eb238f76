"""The `dinov3` encoder: patch tokens of a DINOv3 or DINOv2 transformer (Siméoni et al. 2025).

Tokens are those of the last layer; class and register tokens are left out.  The network is a folder
in the layout of the Hugging Face hub, or a repository in the hub's cache on this machine.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from fide_lab.pretrained.network import IMAGENET_MEAN, IMAGENET_STD, NetworkEncoder
from fide_lab.pretrained.weights import check_finite
from fide_plugins.errors import WeightsMismatchError, WeightsNotFoundError
from fide_plugins.runtime.devices import digest, has_bfloat16
from fide_plugins.runtime.machine import missing

DEFAULT = "facebook/dinov3-vits16-pretrain-lvd1689m"
KINDS = ("dinov3_vit", "dinov2", "dinov2_with_registers")
_FILES = ["config.json", "preprocessor_config.json", "*.safetensors", "*.safetensors.index.json"]
# settings that change the tokens, but not the shapes of the weights
_SETTINGS = ("hidden_act", "layer_norm_eps", "num_attention_heads", "rope_theta")


class DinoEncoder(NetworkEncoder):
    """Patch tokens of a DINO vision transformer; extra `dinov3`.

    On CUDA it computes in bfloat16 if the GPU has that, else in float32; tokens are float32.
    Images are normalized as ``preprocessor_config.json`` says, by default as ImageNet.

    variant: local folder, or repository of the hub.
    download: download the repository into the hub's cache if it is missing there.

    Raises DependencyError without transformers, WeightsNotFoundError if there is no such network,
    and WeightsMismatchError for files that are damaged or hold another network.
    """

    name = "dinov3"

    def __init__(
        self,
        *,
        variant: str = DEFAULT,
        download: bool = False,
        device: str | torch.device = "cpu",
    ) -> None:
        if find_spec("transformers") is None:  # to import it takes seconds
            raise missing("dinov3", "the encoder 'dinov3' needs transformers")
        folder = _find(variant, download)
        mean, std = _colors(folder)
        super().__init__(device=device, mean=mean, std=std)
        on_gpu = self.device.type == "cuda" and has_bfloat16(self.device)
        self._dtype = torch.bfloat16 if on_gpu else torch.float32
        network = _load(folder)
        config: Any = network.config
        self.patch, self.channels = config.patch_size, config.hidden_size
        self._not_patches = 1 + getattr(config, "num_register_tokens", 0)  # class, registers
        kind, bits = config.model_type, str(self._dtype).removeprefix("torch.")
        self.weights_digest = digest(network, extra=[_settings(config), mean, std])
        self.version = f"dinov3-2-{kind}-{self.weights_digest}-{bits}"
        self._network = network.to(self.device, self._dtype)

    def _features(self, images: Tensor) -> Tensor:
        output = self._network(pixel_values=images.to(self._dtype))
        patches: Tensor = output.last_hidden_state[:, self._not_patches :]
        return patches


def _find(variant: str, download: bool) -> Path:
    """Folder with the network's files: the user's own, or one in the hub's cache."""
    folder = Path(variant).expanduser()
    if variant and folder.is_dir():
        return folder
    import huggingface_hub as hub

    try:
        return Path(
            hub.snapshot_download(variant, allow_patterns=_FILES, local_files_only=not download)
        )
    except Exception as error:  # not there, no such name, no consent: errors of many libraries
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise WeightsNotFoundError(
            f"no folder {variant!r}, and no network of that name from the hub ({reason}); "
            f"encoders.make('dinov3', download=True) fetches {DEFAULT} once (86 MB, after consent "
            "to its license on the hub and `hf auth login`), encoders.make('dinov3:FOLDER') reads "
            "a folder of yours, and the encoder 'dense' needs no weights"
        ) from error


def _settings(config: Any) -> list[object]:
    """Values of `_SETTINGS`, numbers as float, so that 100 and 100.0 give the same version."""
    values = [getattr(config, name, None) for name in _SETTINGS]
    return [float(value) if isinstance(value, int | float) else value for value in values]


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text("utf-8")))
    except (ValueError, TypeError) as error:
        raise WeightsMismatchError(f"{path} must hold a JSON object ({error})") from error


def _colors(folder: Path) -> tuple[list[float], list[float]]:
    """Mean and standard deviation of colors that the network expects; ImageNet's by default."""
    path = folder / "preprocessor_config.json"
    stored = _read_json(path) if path.is_file() else {}
    given = stored.get("image_mean", IMAGENET_MEAN), stored.get("image_std", IMAGENET_STD)
    try:
        mean, std = ([float(value) for value in color] for color in given)
    except (TypeError, ValueError):
        mean, std = [], []
    if len(mean) != 3 or len(std) != 3 or min(std) <= 0:
        raise WeightsMismatchError(
            f"{path}: image_mean and image_std must be three numbers each, got {given!r}"
        )
    return mean, std


def _load(folder: Path) -> nn.Module:
    """The float32 network in the folder, whose files hold exactly its weights."""
    config = folder / "config.json"
    if not config.is_file() or not any(folder.glob("*.safetensors")):
        raise WeightsNotFoundError(
            f"{folder} must hold config.json and *.safetensors; other weights are not read"
        )
    kind = _read_json(config).get("model_type")
    if kind not in KINDS:
        raise WeightsMismatchError(
            f"{config}: the model_type must be {' or '.join(KINDS)}, not {kind!r}"
        )
    import transformers

    try:
        with _quiet(transformers), torch.random.fork_rng(devices=[]):  # it also draws weights
            network, found = transformers.AutoModel.from_pretrained(
                folder,
                local_files_only=True,
                use_safetensors=True,
                ignore_mismatched_sizes=True,  # reported below
                output_loading_info=True,
                dtype=torch.float32,
            )
    except Exception as error:  # readers of untrusted bytes raise nearly any error
        raise WeightsMismatchError(
            f"the network in {folder} cannot be read: it is incomplete, damaged or of another kind "
            f"({(str(error).splitlines() or [''])[0]})"
        ) from error
    for problem in ("missing_keys", "unexpected_keys", "mismatched_keys"):
        if found[problem]:
            raise WeightsMismatchError(
                f"{folder} belongs to another network: {problem} {sorted(found[problem])[:3]}"
            )
    check_finite(network.state_dict(), folder)
    loaded: nn.Module = network.eval().requires_grad_(False)
    return loaded


@contextmanager
def _quiet(transformers: Any) -> Iterator[None]:
    """Within this block, transformers prints nothing; `_load` raises our own errors."""
    log = transformers.utils.logging
    verbosity, bar = log.get_verbosity(), log.is_progress_bar_enabled()
    log.set_verbosity_error()
    log.disable_progress_bar()
    try:
        yield
    finally:
        log.set_verbosity(verbosity)
        if bar:
            log.enable_progress_bar()
