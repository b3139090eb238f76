"""The `dinov3` encoder: patch tokens of a DINOv3 or DINOv2 vision transformer, by transformers.

Siméoni et al. 2025, "DINOv3"; Oquab et al. 2023, "DINOv2".  The default is the small DINOv3 with
patches of 16 x 16, the features of the paper.  Tokens are those of the last layer, normalized as
the network does; the tokens of the whole image (class and registers) are left out.

Where the network comes from: a folder with ``config.json`` and ``*.safetensors``, or the name of a
repository of the Hugging Face hub, which is looked for in the hub's cache on this machine.  Only
``download=True`` fetches anything.  The authors ask for consent to DINOv3's license on the hub
before it gives the weights, so an access token is needed there (``hf auth login``).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from fide_plugins.encoders.network import IMAGENET_MEAN, IMAGENET_STD, NetworkEncoder
from fide_plugins.errors import (
    DependencyError,
    OptionError,
    WeightsMismatchError,
    WeightsNotFoundError,
)
from fide_plugins.weights import check_finite, digest

__all__ = ["DEFAULT", "DinoEncoder"]

DEFAULT = "facebook/dinov3-vits16-pretrain-lvd1689m"
KINDS = ("dinov3_vit", "dinov2", "dinov2_with_registers")
_FILES = ["config.json", "preprocessor_config.json", "*.safetensors", "*.safetensors.index.json"]
_PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}


class DinoEncoder(NetworkEncoder):
    """Patch tokens of a DINO vision transformer.

    Parameters
    ----------
    variant
        local folder, or repository of the hub.
    download
        fetch the repository into the hub's cache if it is not there.
    precision
        "float32", "bfloat16" or "float16"; None: float32 on a processor, and on CUDA bfloat16 where
        the GPU has it, float16 where it has not.  Tokens are float32 in any case.
    device
        of the network.

    Raises
    ------
    DependencyError
        transformers is not installed.
    WeightsNotFoundError
        there is no such folder, and nothing in the hub's cache.
    WeightsMismatchError
        what is there is cut short, or no DINO vision transformer.
    """

    name = "dinov3"

    def __init__(
        self,
        *,
        variant: str = DEFAULT,
        download: bool = False,
        precision: str | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        folder = _find(variant, download)
        mean, std = _colors(folder)
        super().__init__(device=device, mean=mean, std=std)
        self._dtype = _dtype(precision, self.device)
        network = _load(folder)
        config: Any = network.config
        self.patch, self.channels = config.patch_size, config.hidden_size
        self._not_patches = 1 + getattr(config, "num_register_tokens", 0)  # class, registers
        kind, bits = config.model_type, str(self._dtype).removeprefix("torch.")
        self.version = f"dinov3-1-{kind}-{digest(network)}-{bits}"
        self._network = network.to(self.device, self._dtype)

    def _features(self, images: Tensor) -> Tensor:
        output = self._network(pixel_values=images.to(self._dtype))
        patches: Tensor = output.last_hidden_state[:, self._not_patches :]
        return patches


def _dtype(precision: str | None, device: torch.device) -> torch.dtype:
    if precision is None:
        if device.type != "cuda":
            return torch.float32
        return torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float16
    if precision not in _PRECISIONS:
        raise OptionError(f"precision must be one of {', '.join(_PRECISIONS)}, not {precision!r}")
    return _PRECISIONS[precision]


def _find(variant: str, download: bool) -> Path:
    """Folder with the network's files."""
    folder = Path(variant).expanduser()
    if variant and folder.is_dir():
        return folder
    hub = _transformers("huggingface_hub")
    with suppress(ValueError):  # no name of a repository
        cached = hub.try_to_load_from_cache(variant, "config.json")
        if isinstance(cached, str) and list(Path(cached).parent.glob("*.safetensors")):
            return Path(cached).parent
    if not download:
        raise WeightsNotFoundError(
            f"no folder {variant!r}, and no network of that name in {hub.constants.HF_HUB_CACHE}; "
            f"encoders.make('dinov3', download=True) fetches {DEFAULT} once (86 MB, after consent "
            "to its license on the hub and `hf auth login`), encoders.make('dinov3:FOLDER') reads "
            "a folder of yours, and the encoder 'dense' needs no weights"
        )
    try:
        return Path(hub.snapshot_download(variant, allow_patterns=_FILES))
    except Exception as error:  # no network, no such name, no consent: errors of many libraries
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise WeightsNotFoundError(
            f"no folder {variant!r}, and the hub did not give the network of that name ({reason})"
        ) from error


def _colors(folder: Path) -> tuple[list[float], list[float]]:
    """Mean and standard deviation of colors that the network expects; ImageNet's if not said."""
    path = folder / "preprocessor_config.json"
    said = _json(path) if path.is_file() else {}
    colors = said.get("image_mean", IMAGENET_MEAN), said.get("image_std", IMAGENET_STD)
    try:
        mean, std = ([float(value) for value in color] for color in colors)
    except (TypeError, ValueError):
        mean, std = [], []
    if len(mean) != 3 or len(std) != 3 or not all(0 < value < 10 for value in std):
        raise WeightsMismatchError(
            f"{path}: image_mean and image_std must be three numbers each, got {colors!r}"
        )
    return mean, std


def _load(folder: Path) -> nn.Module:
    """Network of the folder, float32, all of whose weights, and no others, were found."""
    config_path = folder / "config.json"
    if not config_path.is_file():
        raise WeightsNotFoundError(f"no config.json in {folder}, which must hold a network's files")
    kind = _json(config_path).get("model_type")
    if kind not in KINDS:
        raise WeightsMismatchError(
            f"{config_path}: a network of the encoder 'dinov3' has the model_type "
            f"{' or '.join(KINDS)}, not {kind!r}"
        )
    if not list(folder.glob("*.safetensors")):
        raise WeightsNotFoundError(
            f"no *.safetensors in {folder}; weights in other files are not read"
        )
    transformers = _transformers()
    try:
        with _quiet(transformers), torch.random.fork_rng(devices=[]):  # it draws weights, too
            network, found = transformers.AutoModel.from_pretrained(
                folder,
                local_files_only=True,
                use_safetensors=True,
                ignore_mismatched_sizes=True,  # they are told, below
                output_loading_info=True,
                dtype=torch.float32,
            )
    except Exception as error:  # readers of untrusted bytes raise nearly anything
        raise WeightsMismatchError(
            f"the network in {folder} cannot be read: it is cut short, damaged or of another kind "
            f"({(str(error).splitlines() or [''])[0]})"
        ) from error
    _check(folder, found, network)
    loaded: nn.Module = network.eval().requires_grad_(False)
    return loaded


def _check(folder: Path, found: dict[str, Any], network: nn.Module) -> None:
    """Refuse weights that are missing, too many, of another shape, or not finite."""
    files = sorted(folder.glob("*.safetensors"))
    path = files[0] if len(files) == 1 else folder
    own = network.state_dict()
    for key, stored, needed in sorted(found["mismatched_keys"]):
        raise WeightsMismatchError(
            f"{path}: {key!r} has the shape {tuple(stored)}, and must have {tuple(needed)}"
        )
    for key in sorted(found["missing_keys"]):
        raise WeightsMismatchError(f"{path} has no {key!r}, of shape {tuple(own[key].shape)}")
    for key in sorted(found["unexpected_keys"]):
        raise WeightsMismatchError(
            f"{path} has {key!r}, of shape {_stored_shape(files, key)}, which the network has not"
        )
    check_finite(own, path, own)


def _stored_shape(files: list[Path], key: str) -> tuple[int, ...] | None:
    from safetensors import safe_open

    for path in files:
        with safe_open(path, "pt") as file:
            if key in file.keys():  # noqa: SIM118  it is no mapping
                return tuple(file.get_slice(key).get_shape())
    return None


@contextmanager
def _quiet(transformers: Any) -> Iterator[None]:
    """Within this block, transformers reports nothing; what matters becomes an error of ours."""
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


def _json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text("utf-8"))
    except ValueError as error:
        raise WeightsMismatchError(f"{path} is not JSON ({error})") from error
    if not isinstance(content, dict):
        raise WeightsMismatchError(f"{path} must hold an object, got {type(content).__name__}")
    return content


def _transformers(module: str = "transformers") -> Any:
    from importlib import import_module

    try:
        return import_module(module)
    except ImportError as error:
        raise DependencyError(
            "the encoder 'dinov3' needs transformers: pip install 'fide-plugins[dinov3]'"
        ) from error
