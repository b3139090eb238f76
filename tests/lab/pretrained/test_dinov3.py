"""DINO encoders, of folders that transformers wrote, against transformers' own networks."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fide_lab.pretrained import dinov3
from fide_lab.pretrained.dinov3 import DinoEncoder
from fide_plugins import encoders
from fide_plugins.errors import DependencyError, WeightsMismatchError, WeightsNotFoundError
from fide_plugins.fide import FIDE

transformers = pytest.importorskip("transformers")
hub = pytest.importorskip("huggingface_hub")
safetensors = pytest.importorskip("safetensors.torch")

RNG = np.random.default_rng(13)
KINDS = {"dinov3": (16, 5), "dinov2": (14, 1), "dinov2 with registers": (14, 4)}
KEY = "layer.0.mlp.up_proj.weight"  # in the file of a DINOv3


def copy(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


# -- tokens ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("grid", [(3, 4), (1, 1)])
def test_tokens_are_the_network_s_own(
    kind: str, grid: tuple[int, int], dino_folders: dict[str, Path]
) -> None:
    """Patches only, of images normalized as ImageNet."""
    patch, others = KINDS[kind]
    images = RNG.random((3, patch * grid[0], patch * grid[1], 3), dtype=np.float32)
    normalized = (images - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    network = transformers.AutoModel.from_pretrained(dino_folders[kind]).eval()
    with torch.no_grad():
        x = torch.tensor(normalized, dtype=torch.float32).permute(0, 3, 1, 2)
        states = network(x).last_hidden_state
    assert states.shape == (3, others + grid[0] * grid[1], 32)
    encoder = DinoEncoder(variant=str(dino_folders[kind]))
    tokens = encoder(images)
    torch.testing.assert_close(tokens, states[:, others:], atol=1e-5, rtol=1e-5)
    assert encoder.shape(*images.shape[1:3]) == tokens.shape[1:]


def test_colors_are_those_that_the_folder_names(
    dino_folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = copy(dino_folders["dinov3"], tmp_path)
    colors = {"image_mean": [0.4, 0.5, 0.6], "image_std": [0.2, 0.1, 0.3]}
    (folder / "preprocessor_config.json").write_text(json.dumps(colors))
    images = RNG.random((2, 32, 32, 3), dtype=np.float32)
    imagenet = [np.array(c, np.float32) for c in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))]
    seen = np.clip(images * 0.1 + 0.45, 0, 1)
    same = (seen - colors["image_mean"]) / colors["image_std"] * imagenet[1] + imagenet[0]
    assert same.min() >= 0 and same.max() <= 1
    expected = DinoEncoder(variant=str(dino_folders["dinov3"]))(same.astype(np.float32))
    torch.testing.assert_close(DinoEncoder(variant=str(folder))(seen), expected, atol=1e-4, rtol=0)


def test_the_version_says_which_weights(dino_folders: dict[str, Path], tmp_path: Path) -> None:
    versions = {DinoEncoder(variant=str(folder)).version for folder in dino_folders.values()}
    assert len(versions) == 3
    folder = copy(dino_folders["dinov3"], tmp_path)
    assert DinoEncoder(variant=str(folder)).version in versions
    state = safetensors.load_file(folder / "model.safetensors")
    state["norm.bias"][0] += 1e-6
    safetensors.save_file(state, folder / "model.safetensors", metadata={"format": "pt"})
    assert DinoEncoder(variant=str(folder)).version not in versions


@pytest.mark.parametrize(
    ("file", "key", "value"),
    [
        ("config.json", "num_attention_heads", 4),
        ("config.json", "rope_theta", 50.0),
        ("config.json", "layer_norm_eps", 1e-3),
        ("config.json", "hidden_act", "relu"),
        ("preprocessor_config.json", "image_mean", [0.43, 0.411, 0.296]),
        ("preprocessor_config.json", "image_std", [0.213, 0.156, 0.143]),
    ],
)
def test_the_version_says_what_else_the_tokens_depend_on(
    file: str, key: str, value: object, dino_folders: dict[str, Path], tmp_path: Path
) -> None:
    images = RNG.random((1, 32, 32, 3), dtype=np.float32)
    before = DinoEncoder(variant=str(dino_folders["dinov3"]))
    folder = copy(dino_folders["dinov3"], tmp_path)
    said = json.loads((folder / file).read_text())
    (folder / file).write_text(json.dumps(said | {key: value}))
    after = DinoEncoder(variant=str(folder))
    assert not torch.equal(before(images), after(images)) and before.version != after.version
    (folder / file).write_text(json.dumps(said | {"torch_dtype": "float16", "note": "moved"}))
    assert DinoEncoder(variant=str(folder)).version == before.version


def test_colors_are_imagenets_by_default(dino_folders: dict[str, Path], tmp_path: Path) -> None:
    images = RNG.random((1, 32, 32, 3), dtype=np.float32)
    folder = copy(dino_folders["dinov3"], tmp_path)
    (folder / "preprocessor_config.json").unlink()
    expected = DinoEncoder(variant=str(dino_folders["dinov3"]))(images)
    assert torch.equal(DinoEncoder(variant=str(folder))(images), expected)


# -- where it comes from ---------------------------------------------------------------------------


@pytest.fixture
def hub_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of the hub, and no way to the hub itself."""
    monkeypatch.setattr(hub.constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(hub.constants, "HF_HUB_OFFLINE", True)
    return tmp_path / "hub"


def test_nothing_is_there(hub_cache: Path) -> None:
    message = r"no folder 'facebook/dinov3-vits16.*download=True.*'dense' needs no weights"
    with pytest.raises(WeightsNotFoundError, match=f"(?s){message}"):
        FIDE(3, np.zeros((32, 32, 3)), encoder="dinov3")
    assert not hub_cache.exists()
    for name in ("not a name", ""):  # and not the folder in which this runs
        with pytest.raises(WeightsNotFoundError, match=f"no folder '{name}'"):
            encoders.make(f"dinov3:{name}")


def test_without_transformers_no_weights_are_looked_for(
    hub_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    for name in ("dinov3", f"dinov3:{hub_cache.parent}"):  # neither has weights
        with pytest.raises(DependencyError, match="pip install transformers .*extra dinov3"):
            encoders.make(name)


def test_the_cache_of_the_hub(hub_cache: Path, dino_folders: dict[str, Path]) -> None:
    """Laid out as the hub's own client lays it out: a branch names a commit, which has files."""
    repository = hub_cache / "models--facebook--dinov3-vits16-pretrain-lvd1689m"
    commit = "0123456789abcdef0123456789abcdef01234567"
    (repository / "refs").mkdir(parents=True)
    (repository / "refs" / "main").write_text(commit)
    snapshot = repository / "snapshots" / commit
    shutil.copytree(dino_folders["dinov3"], snapshot)
    expected = encoders.make(f"dinov3:{dino_folders['dinov3']}")
    assert encoders.make("dinov3").version == expected.version
    (snapshot / "model.safetensors").unlink()
    with pytest.raises(WeightsNotFoundError, match="must hold"):
        encoders.make("dinov3")


def test_only_a_download_may_ask_the_hub(
    dino_folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, bool]] = []

    def snapshot_download(name: str, *, allow_patterns: list[str], local_files_only: bool) -> str:
        assert not {"*.bin", "*.pt", "*"} & set(allow_patterns)
        asked.append((name, local_files_only))
        if name == "facebook/nothing":
            raise ConnectionError("no route")
        return str(dino_folders["dinov3"])

    monkeypatch.setattr(hub, "snapshot_download", snapshot_download)
    encoders.make("dinov3")
    assert encoders.make("dinov3", download=True).shape(32, 32) == (4, 32)
    with pytest.raises(WeightsNotFoundError, match=r"from the hub \(no route\)"):
        encoders.make("dinov3:facebook/nothing", download=True)
    default = dinov3.DEFAULT
    assert asked == [(default, True), (default, False), ("facebook/nothing", False)]


def test_weights_in_several_files(dino_folders: dict[str, Path], tmp_path: Path) -> None:
    network = transformers.AutoModel.from_pretrained(dino_folders["dinov3"])
    network.save_pretrained(tmp_path, max_shard_size="40KB")
    shutil.copy(dino_folders["dinov3"] / "preprocessor_config.json", tmp_path)
    shards = sorted(tmp_path.glob("*.safetensors"))
    assert len(shards) > 1
    whole = encoders.make(f"dinov3:{dino_folders['dinov3']}")
    assert encoders.make(f"dinov3:{tmp_path}").version == whole.version
    shards[-1].unlink()
    with pytest.raises(WeightsMismatchError, match="cannot be read: it is incomplete"):
        encoders.make(f"dinov3:{tmp_path}")


# -- what is refused -------------------------------------------------------------------------------


CHANGES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "missing": (lambda state: state.pop(KEY), r"missing_keys \['.*up_proj"),
    "shape": (lambda state: state.update({KEY: torch.zeros(64, 31)}), r"mismatched_keys .*up_proj"),
    "unexpected": (lambda state: state.update({"head.weight": torch.zeros(9)}), "unexpected_keys"),
    "infinite": (lambda state: state[KEY].fill_(torch.inf), r"up_proj.* not finite"),
}


@pytest.mark.parametrize("what", CHANGES)
def test_weights_that_do_not_fit(
    what: str,
    dino_folders: dict[str, Path],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    change, message = CHANGES[what]
    folder = copy(dino_folders["dinov3"], tmp_path)
    state = safetensors.load_file(folder / "model.safetensors")
    change(state)
    safetensors.save_file(state, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(WeightsMismatchError, match=message):
        encoders.make(f"dinov3:{folder}")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("share", [0.0, 0.9])
def test_cut_short(share: float, dino_folders: dict[str, Path], tmp_path: Path) -> None:
    folder = copy(dino_folders["dinov3"], tmp_path)
    data = (folder / "model.safetensors").read_bytes()
    (folder / "model.safetensors").write_bytes(data[: int(share * len(data))])
    with pytest.raises(WeightsMismatchError, match="cannot be read: it is incomplete, damaged"):
        encoders.make(f"dinov3:{folder}")


def test_other_networks_and_files(dino_folders: dict[str, Path], tmp_path: Path) -> None:
    folder = copy(dino_folders["dinov3"], tmp_path)
    config = folder / "config.json"
    said = json.loads(config.read_text())
    for text, message in [
        (json.dumps(said | {"model_type": "bert"}), r"model_type must be .*, not 'bert'"),
        ("[1]", r"config\.json must hold a JSON object"),
        ("{", r"config\.json must hold a JSON object"),
        (json.dumps(said | {"hidden_size": 40}), "mismatched_keys"),
    ]:
        config.write_text(text)
        with pytest.raises(WeightsMismatchError, match=message):
            encoders.make(f"dinov3:{folder}")
    config.write_text(json.dumps(said))
    (folder / "preprocessor_config.json").write_text('{"image_std": [0, 1]}')
    with pytest.raises(WeightsMismatchError, match=r"image_mean and image_std must be three"):
        encoders.make(f"dinov3:{folder}")
    shutil.copy(dino_folders["dinov3"] / "preprocessor_config.json", folder)
    state = safetensors.load_file(folder / "model.safetensors")
    (folder / "model.safetensors").unlink()
    torch.save(state, folder / "pytorch_model.bin")  # may be pickled, so it is not read
    with pytest.raises(WeightsNotFoundError, match="must hold config.json and"):
        encoders.make(f"dinov3:{folder}")
    config.unlink()
    with pytest.raises(WeightsNotFoundError, match="must hold config.json and"):
        encoders.make(f"dinov3:{folder}")
