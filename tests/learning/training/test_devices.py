"""Where a network trains: CUDA where there is some; the model computes on the CPU.

Without a GPU there is still PyTorch's device "meta", whose tensors have no numbers: it refuses to
mix them with others. So a loss that can be computed there computes on any one device.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins.cli import main
from fide_plugins.errors import DeviceError, DeviceMemoryError
from fide_plugins.learning import learn, networks as sets
from fide_plugins.learning.augmentation import AUGMENT, augmented
from fide_plugins.learning.emulator import Emulator
from fide_plugins.learning.networks import Encoder, Network, Trainable, as_input
from fide_plugins.learning.training import Training
from tests.learning.conftest import SIDE, SPACE, disk

BLOCKS = [[0, 1], [2, 3]]


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize(
    ("head", "blocks"), [("autoregressive", []), ("mixture", []), ("set", BLOCKS)]
)
def test_the_loss_of_each_head_is_computed_where_the_network_is(
    head: str, blocks: Sequence[Sequence[int]], periodic: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def matching(gain: Tensor) -> Tensor:  # theirs needs the numbers
        return torch.arange(2, device=gain.device).expand(len(gain), -1)

    monkeypatch.setattr(sets, "_matching", matching)
    network = Network((32, 32), [periodic] * 5, head, blocks).to("meta")
    images, u = torch.zeros(8, 3, 32, 32, device="meta"), torch.zeros(8, 5, device="meta")
    loss: Any = -network.log_prob(images, u).mean()
    loss.backward()
    assert {w.grad.device.type for w in network.parameters() if w.grad is not None} == {"meta"}
    with pytest.raises(RuntimeError, match="device"):  # or this test could not fail
        network.log_prob(images, torch.zeros(8, 5))


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("others", [0, 1])
def test_the_errors_of_an_emulator_are_computed_where_it_is(others: int, periodic: bool) -> None:
    d = 4 + others
    emulator = Emulator((32, 32), [periodic] * d, BLOCKS).to("meta")
    images, u = torch.zeros(8, 3, 32, 32, device="meta"), torch.zeros(8, d, device="meta")
    emulator.standardize(images)
    loss: Any = emulator.errors(images, u, torch.arange(7, device="meta")).mean()
    loss.backward()
    assert {w.grad.device.type for w in emulator.parameters() if w.grad is not None} == {"meta"}
    with pytest.raises(RuntimeError, match="device"):  # or this test could not fail
        emulator.errors(images, torch.zeros(8, d), torch.arange(7, device="meta"))


def test_blocks_are_matched_on_the_cpu_and_taken_back() -> None:
    gain = torch.tensor([[[0.0, 1.0], [1.0, 0.0]], [[1.0, 0.0], [0.0, 1.0]]], requires_grad=True)
    assert sets._matching(gain).tolist() == [[1, 0], [0, 1]]


@pytest.mark.parametrize("device", ["cuda", "rubbish", 3.5])
def test_a_device_that_is_not_there_is_refused_before_anything_is_rendered(device: str) -> None:
    def never(params: object) -> None:
        raise AssertionError("it rendered")

    with pytest.raises(DeviceError, match="'auto' or 'cpu' works"):
        learn(never, SPACE, renders=200, device=device)


# -- on a real GPU ---------------------------------------------------------------------------------


def made(kind: str) -> Trainable:
    """A network with a head of this kind, or an emulator."""
    periodic = [False] * 4 + [True]
    if kind == "emulator":
        return Emulator((32, 32), periodic, BLOCKS)
    return Network((32, 32), periodic, kind, BLOCKS if kind == "set" else [])


def trainings(kind: str, augment: str = "none") -> list[Training]:
    """The same on a GPU and on the CPU; images are noise, but those of an emulator are gray."""
    rng = np.random.default_rng(0)
    x, images = rng.random((640, 5)), rng.integers(0, 256, (640, 32, 32, 3), dtype=np.uint8)
    if kind == "emulator":
        images[:] = np.rint(255 * x[:, :4].mean(axis=1))[:, None, None, None]
    networks = [made(kind).to(device) for device in ("cuda", "cpu")]
    return [Training(network, x, images, 1, augment=augment) for network in networks]


@pytest.mark.gpu
@pytest.mark.parametrize("head", ["autoregressive", "mixture", "set"])
def test_a_pass_of_training_as_on_the_processor(head: str) -> None:
    there, here = trainings(head)
    assert there.test() == pytest.approx(here.test(), abs=1e-3)
    for training in (there, here):
        training.run()
    assert there.curve[0][1:] == pytest.approx(here.curve[0][1:], abs=0.05)
    assert there.network.device.type == "cuda"


@pytest.mark.gpu
def test_a_pass_of_an_emulator_as_on_the_processor() -> None:
    """It explains as much of renders, at random places that are others there.

    What was learned there has the same errors on the processor, place by place.
    """
    there, here = trainings("emulator")
    for training in (there, here):
        training.passes, training.learning_rate = 10, 4e-3
        training.run()
        assert training.best < 0.5
    assert there.network.device.type == "cuda"
    emulators = [there.network, here.network]
    emulators[1].load(emulators[0].state_dict())
    images, u = as_input(there.images[:8]), torch.from_numpy(there.x[:8]).float()
    places, errors = torch.arange(0, 1024, 37), []
    for emulator in emulators:
        assert isinstance(emulator, Emulator)
        with torch.no_grad():
            args = (each.to(emulator.device) for each in (images, u, places))
            errors.append(emulator.errors(*args).cpu())
    assert errors[0].min() > 0
    torch.testing.assert_close(*errors, rtol=1e-2, atol=1e-6)


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("kind", "augment"), [("autoregressive", "photograph"), ("emulator", "none")]
)
def test_a_training_goes_on_there_and_on_the_processor(kind: str, augment: str) -> None:
    there, here = trainings(kind, augment)
    there.run()
    state = there.state_dict()
    for training in (there, here):
        training.load_state_dict(state)
        training.passes = 2
        training.run()
        assert len(training.curve) == 2


@pytest.mark.gpu
@pytest.mark.parametrize("kind", ["autoregressive", "mixture", "set", "emulator"])
def test_a_training_gives_the_same_weights_every_time_there(kind: str) -> None:
    before = torch.backends.cudnn.deterministic
    weights = []
    for _ in range(3):
        training = trainings(kind)[0]
        training.passes = 2
        training.run()
        weights.append([w.detach().cpu() for w in training.network.parameters()])
    for again in weights[1:]:
        torch.testing.assert_close(again, weights[0], rtol=0, atol=0)
    assert torch.backends.cudnn.deterministic == before


@pytest.mark.gpu
@pytest.mark.parametrize("augment", AUGMENT)
def test_images_are_changed_there(augment: str) -> None:
    images = as_input(np.zeros((8, 16, 16, 3), np.uint8), "cuda")
    changed = [augmented(images, torch.Generator("cuda").manual_seed(1), augment) for _ in range(2)]
    assert changed[0].device.type == "cuda"
    torch.testing.assert_close(*changed)


@pytest.mark.gpu
def test_a_model_that_was_learned_there_computes_on_the_processor() -> None:
    model = learn(disk, SPACE, renders=1200, size=SIDE, passes=6, device="cuda")
    assert model.network.device.type == "cpu"
    assert model.report.nll < -1.0
    assert model.sample(disk({"x": 0.3, "y": 0.6, "gray": 0.5}), 4).shape == (4, 4)


@pytest.mark.gpu
def test_an_emulator_that_was_learned_there_computes_on_the_processor() -> None:
    words: dict[str, Any] = {"size": SIDE, "passes": 1, "groups": [[0], [1]], "device": "cuda"}
    model = learn(disk, SPACE, renders=200, **words)
    assert model.emulator is not None
    assert model.emulator.device.type == "cpu"
    picture = disk({"x": 0.3, "y": 0.6, "gray": 0.5})
    assert model.refined(picture, np.full((2, 4), 0.5)).shape == (2, 4)


PLACES = {
    "to": Network,  # the network itself
    "standardize": Encoder,  # what its first images are measured by
    "_batch": Training,  # images
    "_step": Training,  # gradients, in a library that PyTorch calls
}


@pytest.fixture(params=PLACES)
def full_gpu(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> RuntimeError:
    """A GPU that has no room for something."""
    error: RuntimeError = torch.OutOfMemoryError("CUDA out of memory")
    if request.param == "_step":
        error = RuntimeError("CUBLAS_STATUS_ALLOC_FAILED")

    def full(*_: object) -> NoReturn:
        raise error

    def to(self: Network, device: object = None, **_: object) -> Network:
        return full() if device is not None and request.param == "to" else self

    module = importlib.import_module("fide_plugins.learning.pipeline")
    monkeypatch.setattr(module, "resolve_device", torch.device)
    monkeypatch.setattr(Network, "to", to)
    if request.param != "to":
        monkeypatch.setattr(PLACES[request.param], request.param, full)
    return error


def test_a_full_gpu_is_an_error_with_a_remedy(
    full_gpu: RuntimeError, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """What was rendered is kept: another device goes on with it."""
    options: dict[str, Any] = {"renders": 100, "size": SIDE, "passes": 1, "out": tmp_path / "m"}
    said = f"cuda has too little memory for training .{full_gpu}.; take device='cpu'"
    with pytest.raises(DeviceMemoryError, match=said) as raised:
        learn(disk, SPACE, **options, device="cuda")
    assert raised.value.__cause__ is full_gpu
    assert (tmp_path / "m.renders" / "000000.npz").exists()
    monkeypatch.undo()
    assert learn(disk, SPACE, **options, device="cpu").report.renders == 98


@pytest.mark.parametrize(
    ("error", "raised"),
    [
        (torch.OutOfMemoryError("CUDA out of memory"), DeviceMemoryError),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), RuntimeError),
        (MemoryError(), MemoryError),
    ],
)
def test_an_earlier_training_for_which_there_is_no_memory_is_no_damaged_file(
    error: Exception, raised: type[Exception], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    options: dict[str, Any] = {"renders": 100, "size": SIDE, "out": tmp_path / "m"}
    learn(disk, SPACE, **options, passes=1, device="cpu")

    def full(*_: object) -> NoReturn:
        raise error

    module = importlib.import_module("fide_plugins.learning.pipeline")
    with monkeypatch.context() as patch:
        patch.setattr(module, "resolve_device", torch.device)
        patch.setattr(Network, "to", lambda network, *_, **__: network)
        patch.setattr(Training, "load_state_dict", full)
        with pytest.raises(raised) as caught:
            learn(disk, SPACE, **options, passes=2, device="cuda")
    assert caught.type is raised
    assert learn(disk, SPACE, **options, passes=2, device="cpu").report.renders == 98


def test_main_memory_is_not_the_gpu_s(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def full(*_: object) -> NoReturn:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate")

    module = importlib.import_module("fide_plugins.learning.pipeline")
    monkeypatch.setattr(module, "resolve_device", torch.device)
    monkeypatch.setattr(Network, "to", lambda network, *_, **__: network)
    monkeypatch.setattr(Training, "_batch", full)
    with pytest.raises(RuntimeError, match="DefaultCPUAllocator") as raised:
        learn(disk, SPACE, renders=100, size=SIDE, passes=1, device="cuda")
    assert not isinstance(raised.value, DeviceMemoryError)


def test_the_command_says_how_to_go_on_after_a_full_gpu(
    full_gpu: RuntimeError, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (empty_folder / "scene.py").write_text(SCENE)
    words = "learn scene.py:render --renders 100 --size 16 --passes 1 --device cuda --out m.fide"
    assert main(words.split()) == 1
    said = capsys.readouterr().err
    assert f"it stopped: cuda has too little memory for training ({full_gpu})" in said
    assert "m.fide.renders" in said and "continue with: fide learn scene.py:render" in said


SCENE = """
import numpy as np
from fide_plugins import Float, Space

space = Space(left=Float(0, 1), right=Float(0, 1))


def render(params):
    return np.repeat(np.linspace(params["left"], params["right"], 16)[None], 16, axis=0)
"""
