"""Files of weights: found where they are said to be, read without running them, or refused."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from fide_lab.pretrained import weights
from fide_lab.pretrained.weights import Published
from fide_plugins.errors import WeightsMismatchError, WeightsNotFoundError

STATE = {"0.weight": torch.arange(6.0).reshape(2, 3), "0.bias": torch.ones(2)}


def small_network() -> nn.Module:
    with torch.device("meta"):
        return nn.Sequential(nn.Linear(3, 2))


def published(content: bytes, folder: Path) -> Published:
    """A file that is published at an address which needs no network."""
    source = folder / "published.pth"
    source.write_bytes(content)
    return Published("Net", "net.pth", source.as_uri(), hashlib.sha256(content).hexdigest()[:8])


# -- finding ---------------------------------------------------------------------------------------


def test_nothing_is_downloaded_unless_asked_for(no_weights: Path, tmp_path: Path) -> None:
    net = published(b"weights", tmp_path)
    with pytest.raises(WeightsNotFoundError):
        net.find()
    assert not no_weights.exists()
    with pytest.raises(WeightsNotFoundError, match=r"own\.pth"):
        net.find("own.pth", download=True)  # a file that was named is not replaced by another
    assert not no_weights.exists()
    path = net.find(download=True)
    assert path == net.cached and path.read_bytes() == b"weights"
    (tmp_path / "published.pth").unlink()
    assert net.find(download=True) == path  # once is enough


@pytest.mark.parametrize("what", ["absent", "another"])
def test_a_download_that_fails_leaves_nothing(no_weights: Path, tmp_path: Path, what: str) -> None:
    net = published(b"weights", tmp_path)
    if what == "absent":
        (tmp_path / "published.pth").unlink()
    else:
        (tmp_path / "published.pth").write_bytes(b"something else")
    with pytest.raises(WeightsNotFoundError, match=r"Net: file:.* could not be downloaded to"):
        net.find(download=True)
    assert not net.cached.exists()


# -- reading ---------------------------------------------------------------------------------------


def save_zip(path: Path) -> None:
    torch.save(STATE, path)


def save_old(path: Path) -> None:
    """As PyTorch wrote files when the weights of VGG were published."""
    torch.save(STATE, path, _use_new_zipfile_serialization=False)


FORMATS: list[tuple[str, Callable[[Path], None]]] = [
    ("new.pth", save_zip),
    ("old.pth", save_old),
]


@pytest.mark.parametrize(("name", "save"), FORMATS)
def test_every_format(name: str, save: Callable[[Path], None], tmp_path: Path) -> None:
    save(tmp_path / name)
    state = weights.read(tmp_path / name)
    assert set(state) == set(STATE)
    for key, value in STATE.items():
        assert torch.equal(state[key], value)


@pytest.mark.parametrize(("name", "save"), FORMATS)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.98])
def test_cut_short(name: str, save: Callable[[Path], None], share: float, tmp_path: Path) -> None:
    path = tmp_path / name
    save(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(WeightsMismatchError, match=rf"{name} is cut short, damaged") as error:
        weights.read(path)
    assert isinstance(error.value, ValueError) and isinstance(error.value, OSError)


class Trap:
    """What a hostile file holds: unpickled, it would write a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.write_text, (self.path, "sprung")


@pytest.mark.parametrize("how", ["torch", "old torch", "pickle"])
def test_no_code_in_a_file_runs(how: str, tmp_path: Path) -> None:
    path, sprung = tmp_path / "hostile.pth", tmp_path / "sprung"
    content = {"0.weight": Trap(sprung)}
    if how == "pickle":
        path.write_bytes(pickle.dumps(content))
    else:
        torch.save(content, path, _use_new_zipfile_serialization=how == "torch")
    with pytest.raises(WeightsMismatchError, match="holds more than tensors") as error:
        weights.read(path)
    assert not sprung.exists()
    assert "weights_only" not in str(error.value)  # no advice to set it to False
    if how == "pickle":
        pickle.loads(path.read_bytes())
    else:
        torch.load(path, weights_only=False)
    assert sprung.exists()  # so it was a trap


@pytest.mark.parametrize("content", [torch.ones(3), [torch.ones(3)], {"a": 1}, {1: torch.ones(3)}])
def test_what_is_no_state_dict(content: object, tmp_path: Path) -> None:
    torch.save(content, tmp_path / "odd.pth")
    with pytest.raises(WeightsMismatchError, match=r"odd\.pth must hold tensors by name"):
        weights.read(tmp_path / "odd.pth")


# -- fitting ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_a_network_is_filled(dtype: torch.dtype) -> None:
    network = small_network()
    given = {k: v.to(dtype, copy=True) for k, v in STATE.items()} | {"head.bias": torch.ones(1)}
    weights.fill(network, given, Path("f"), ignored=("head.",))
    x = torch.tensor([[1.0, 0.0, 2.0]])
    assert torch.equal(network(x), x @ STATE["0.weight"].T + 1)
    assert not network.training
    assert all(p.dtype == torch.float32 and not p.requires_grad for p in network.parameters())
    given["0.bias"] += 1
    assert torch.equal(network(x), x @ STATE["0.weight"].T + 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"0.bias": None}, r"0\.bias"),
        ({"0.weight": torch.ones(2, 4)}, r"0\.weight.*\[2, 4\].*\[2, 3\]"),
        ({"1.weight": torch.ones(5)}, r"1\.weight"),
        ({"0.bias": torch.tensor([1, torch.nan])}, r"'0.bias' has values that are not finite"),
    ],
)
def test_what_does_not_fit(change: dict[str, Any], message: str) -> None:
    state = {key: value for key, value in (STATE | change).items() if value is not None}
    with pytest.raises(WeightsMismatchError, match=rf"(?s)f\.pth.*{message}"):
        weights.fill(small_network(), state, Path("f.pth"), ignored=("head.",))
