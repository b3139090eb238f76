"""The `dinov3` encoder: patch tokens of a DINOv3 or DINOv2 vision transformer.

Siméoni et al. 2025, "DINOv3"; Oquab et al. 2023, "DINOv2".  The default is the small DINOv3 with
patches of 16 x 16, the features of the paper.  Tokens are those of the last layer, with the
network's own normalization; class and register tokens are left out.  The package `transformers`
computes them.

The network is a folder with ``config.json`` and ``*.safetensors``, or a repository of the Hugging
Face hub in the hub's cache on this machine.  Only ``download=True`` downloads anything.  The hub
requires consent to DINOv3's license, and thus an access token (``hf auth login``).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from fide_plugins.encoders.pretrained import dino_files
from fide_plugins.encoders.pretrained.dino_files import DEFAULT
from fide_plugins.encoders.pretrained.network import NetworkEncoder
from fide_plugins.encoders.pretrained.weights import check_finite
from fide_plugins.errors import OptionError, WeightsMismatchError, WeightsNotFoundError
from fide_plugins.runtime.devices import digest, has_bfloat16

__all__ = ["DEFAULT", "DinoEncoder"]

KINDS = ("dinov3_vit", "dinov2", "dinov2_with_registers")
# settings that change the tokens, but not the shapes of the weights
_SETTINGS = ("hidden_act", "layer_norm_eps", "num_attention_heads", "rope_theta")
_PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}


class DinoEncoder(NetworkEncoder):
    """Patch tokens of a DINO vision transformer.

    Parameters
    ----------
    variant
        local folder, or repository of the hub.
    download
        download the repository into the hub's cache if it is missing there.
    precision
        "float32", "bfloat16" or "float16"; None: float32 on a CPU, and on CUDA bfloat16 if the GPU
        supports it, otherwise float16.  Tokens are always float32.
    device
        device of the network.

    Raises
    ------
    DependencyError
        transformers is not installed.
    WeightsNotFoundError
        there is no such folder, and the hub's cache does not hold the complete network.
    WeightsMismatchError
        the files are truncated, or hold no DINO vision transformer.

    Warns
    -----
    RuntimeWarning
        the files do not give the network's training colors; ImageNet's are assumed.
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
        folder = dino_files.find(variant, download)
        mean, std = dino_files.colors(folder, Path(variant).name)
        super().__init__(device=device, mean=mean, std=std)
        self._dtype = _dtype(precision, self.device)
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


def _dtype(precision: str | None, device: torch.device) -> torch.dtype:
    if precision is None:
        if device.type != "cuda":
            return torch.float32
        return torch.bfloat16 if has_bfloat16(device) else torch.float16
    if precision not in _PRECISIONS:
        raise OptionError(f"precision must be one of {', '.join(_PRECISIONS)}, not {precision!r}")
    return _PRECISIONS[precision]


def _settings(config: Any) -> list[object]:
    """Values of `_SETTINGS`, numbers as float, so that 100 and 100.0 give the same version."""
    values = [getattr(config, name, None) for name in _SETTINGS]
    return [float(value) if isinstance(value, int | float) else value for value in values]


def _load(folder: Path) -> nn.Module:
    """The float32 network in the folder, whose files hold exactly its weights."""
    config_path = folder / "config.json"
    if not config_path.is_file():
        raise WeightsNotFoundError(f"no config.json in {folder}, which must hold a network's files")
    kind = dino_files.read_json(config_path).get("model_type")
    if kind not in KINDS:
        raise WeightsMismatchError(
            f"{config_path}: a network of the encoder 'dinov3' has the model_type "
            f"{' or '.join(KINDS)}, not {kind!r}"
        )
    absent = dino_files.missing(folder)
    if absent:
        raise WeightsNotFoundError(
            f"no {', '.join(absent)} in {folder}; weights in other files are not read"
        )
    transformers = dino_files.library()
    try:
        with _quiet(transformers), torch.random.fork_rng(devices=[]):  # it also draws weights
            network, found = transformers.AutoModel.from_pretrained(
                folder,
                local_files_only=True,
                use_safetensors=True,
                ignore_mismatched_sizes=True,  # `_check` reports them
                output_loading_info=True,
                dtype=torch.float32,
            )
    except Exception as error:  # readers of untrusted bytes raise nearly any error
        what = dino_files.unreadable(folder) or f"the network in {folder}"
        raise WeightsMismatchError(
            f"{what} cannot be read: it is truncated, damaged or of another kind "
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
            f"{path} has {key!r}, of shape {_stored_shape(files, key)}, which this network does "
            "not have"
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
    """Within this block, transformers prints nothing; `_check` raises our own errors."""
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
