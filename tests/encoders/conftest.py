"""Encoders of every name: those with a network get random weights, laid out like the real ones."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from fide_plugins import encoders
from fide_plugins.encoders.base import PatchEncoder

TINY: dict[str, Any] = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
CONFIGS: dict[str, tuple[str, dict[str, Any]]] = {  # kind: class in transformers, its settings
    "dinov3": ("DINOv3ViT", {"patch_size": 16, "intermediate_size": 64, "num_register_tokens": 4}),
    "dinov2": ("Dinov2", {"patch_size": 14, "image_size": 56, "mlp_ratio": 2}),
    "dinov2 with registers": (
        "Dinov2WithRegisters",
        {"patch_size": 14, "image_size": 56, "mlp_ratio": 2, "num_register_tokens": 3},
    ),
}


@pytest.fixture(scope="session")
def dino_folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folders, by kind, of very small networks with random weights, saved by transformers."""
    transformers = pytest.importorskip("transformers")
    transformers.utils.logging.disable_progress_bar()
    folders: dict[str, Path] = {}
    for kind, (name, settings) in CONFIGS.items():
        config = getattr(transformers, f"{name}Config")(**TINY, **settings)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(len(folders))
            network = getattr(transformers, f"{name}Model")(config).float()  # whoever asks first
            for parameter in network.parameters():  # gains and offsets, too, are not trivial
                parameter.data += 0.1 * torch.randn_like(parameter)
        folders[kind] = tmp_path_factory.mktemp("dino") / kind
        network.save_pretrained(folders[kind])
    colors = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
    (folders["dinov3"] / "preprocessor_config.json").write_text(json.dumps(colors))
    return folders


@pytest.fixture
def make(request: pytest.FixtureRequest) -> Callable[..., PatchEncoder]:
    """Replacement of `encoders.make` that finds weights for every name."""

    def make(name: str, **options: Any) -> PatchEncoder:
        if name == "dinov3":
            options["variant"] = str(request.getfixturevalue("dino_folders")["dinov3"])
        elif name == "vgg19":
            request.getfixturevalue("cached_weights")
        return encoders.make(name, **options)

    return make
