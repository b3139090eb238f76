"""Training of a network: schedule, checkpoints, changed renders, devices."""

from __future__ import annotations

import importlib
import random
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins.cli import main
from fide_plugins.errors import DependencyError, DeviceError, DeviceMemoryError
from fide_plugins.learning import augmentation, learn, networks as sets
from fide_plugins.learning.augmentation import augmented, check_installed
from fide_plugins.learning.emulator import Emulator
from fide_plugins.learning.networks import Encoder, Network, Trainable, as_input
from fide_plugins.learning.training import Training
from fide_plugins.runtime import checkpoint
from fide_plugins.types import Float64
from tests.learning.conftest import SIDE, SPACE, disk

PERIOD = 10.0  # seconds of a step, by a clock of our own


class Stepping(Training):
    """Notes the rate of each step, which takes ten seconds."""

    rates: list[float]
    now: list[float]

    def _step(self, loss: Tensor) -> None:
        self.rates.append(self._optimizer.param_groups[0]["lr"])
        self.now[0] += PERIOD
        super()._step(loss)


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def training(now: list[float], seconds: float | None, passes: int = 4) -> Stepping:
    """Of two gray levels, in ten steps a pass."""
    x = np.random.default_rng(0).random((1300, 2))
    images = np.repeat(np.uint8(x * 255), 8, axis=1)[:, :, None, None]  # (n, 16, 1, 1)
    images = np.broadcast_to(images, (1300, 16, 16, 3)).copy()
    network = Network((16, 16), (False, False))
    made = Stepping(network, x, images, passes, seconds=seconds, batch=128)
    made.rates, made.now = [], now
    return made


@pytest.mark.thorough
def test_training_stops_when_the_time_is_up(now: list[float]) -> None:
    saved: list[dict[str, Any]] = []
    short = training(now, 14.5 * PERIOD)
    short.run(save=saved.append)
    assert len(short.rates) == 15 and min(short.rates) > 0
    assert short.passed == 1 and short.spent == 15 * PERIOD
    assert [row[0] for row in short.curve] == [1274, 1274 + 5 * 128]
    assert np.isfinite(short.curve[-1]).all()

    more = training(now, 1000 * PERIOD)
    more.load_state_dict(saved[-1])
    more.run()  # what was over stays so
    assert not more.rates and more.curve == short.curve


def test_no_time_is_one_step_and_no_pass(now: list[float]) -> None:
    least = training(now, 1e-3)
    least.run()
    assert (len(least.rates), least.passed, len(least.curve)) == (1, 0, 1)
    assert least.over


SMALL = 16
STEP = 10.0  # seconds of a step of training, by a clock of our own; a render takes one
TIME = 404.0  # 101 for renders, 202 for the density, and 101 for the emulator


class Stop(Exception):
    """Raised while the emulator is learned."""


class Clock:
    """Time that passes where something is rendered or trained."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.now, self.steps = 0.0, 0
        self.stop_at: int | None = None
        """Step of the emulator that is interrupted."""
        step = Training._step

        def timed(training: Training, loss: Tensor) -> None:
            if isinstance(training.network, Emulator):
                if self.steps == self.stop_at:
                    raise Stop
                self.steps += 1
            self.now += STEP
            step(training, loss)

        patch.setattr(time, "monotonic", lambda: self.now)
        patch.setattr(Training, "_step", timed)
        # time alone ends it
        patch.setattr("fide_plugins.learning.training._PATIENCE", 1000)

    def render(self, x: Float64) -> Float64:
        """As bright as the sum of two lamps."""
        self.now += 1
        return np.full((SMALL, SMALL), x.mean())


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def learned(clock: Clock, out: Path, **options: Any) -> dict[str, dict[str, Any]]:
    """State of the trainings at the end of a call."""
    options = {"time": TIME, "passes": 1000, **options}
    learn(clock.render, 2, renders=100, size=SMALL, groups=[[0], [1]], out=out, **options)
    return states(out)


def states(out: Path) -> dict[str, dict[str, Any]]:
    folder = Path(f"{out}.renders")
    names = [name for name in ("training", "emulator") if (folder / name).exists()]
    return {name: checkpoint.read(folder / name, "training")["state"] for name in names}


@pytest.mark.thorough
def test_a_quarter_of_the_time_is_the_emulator_s(clock: Clock, tmp_path: Path) -> None:
    there = learned(clock, tmp_path / "m")
    assert there["training"]["spent"] == 210  # the step that is under way is finished
    assert there["emulator"]["spent"] == 100
    alone = learned(clock, tmp_path / "n", emulator=False)
    assert alone["training"]["spent"] == 310 and "emulator" not in alone


Change = Callable[[Tensor, torch.Generator], Tensor]
CHANGES: list[Change] = [change for change, _ in augmentation._CHANGES["photograph"]]
every_change = pytest.mark.parametrize("change", CHANGES)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def waves(n: int = 40, size: int = 24) -> Tensor:
    """Images (n, 3, size, size) of soft structure in [0.2, 0.8], all the same."""
    rows, columns = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    planes = [torch.sin(rows / 3), torch.cos(columns / 4), torch.sin((rows + columns) / 5)]
    return (0.5 + 0.3 * torch.stack(planes)).expand(n, 3, size, size).contiguous()


def test_the_same_generator_makes_the_same_changes_and_no_other_is_used() -> None:
    images = waves()
    before = images.clone()
    state = torch.random.get_rng_state(), str(np.random.get_state()), random.getstate()
    first, again, other = (augmented(images, seeded(seed)) for seed in (3, 3, 4))
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert torch.equal(images, before)
    assert torch.equal(torch.random.get_rng_state(), state[0])
    assert (str(np.random.get_state()), random.getstate()) == state[1:]


def test_what_two_renders_differ_in_moves_nothing_and_keeps_colors() -> None:
    """Focus and noise alone: flat images keep their color but for noise, and edges their place."""
    flat = torch.full((400, 3, 16, 16), 0.4)
    mean = augmented(flat, seeded(), "render").mean((2, 3))
    assert float((mean - 0.4).abs().max()) < 6 * 0.02 / 16  # six standard errors of the noise
    rows = torch.linspace(0.2, 0.8, 16)[:, None].expand(400, 3, 16, 16).contiguous()
    changed = (augmented(rows, seeded(), "render") - rows)[:, :, 2:-2, 2:-2].mean((1, 2, 3))
    assert float(changed.abs().max()) < 6 * 0.02 / (3 * 144) ** 0.5
    moved = (augmented(rows, seeded()) - rows)[:, :, 2:-2, 2:-2].mean((1, 2, 3))
    assert float(moved.abs().max()) > 0.01


@every_change
def test_each_image_is_changed_in_its_own_way(change: Change) -> None:
    images = waves()
    out = change(images, seeded())
    assert len({tuple(image.flatten().tolist()) for image in out}) > len(images) // 2


def test_what_is_in_front_is_one_rectangle_of_one_color() -> None:
    images = waves(200)
    hidden = (augmentation.in_front(images, seeded()) != images).any(1)  # (n, H, W)
    share = hidden.float().mean((1, 2))
    assert float(share.max()) <= (0.3 + 1 / 24) ** 2 and float(share.max()) > 0.04
    rows, columns = hidden.any(2), hidden.any(1)
    assert torch.equal(hidden, rows[:, :, None] & columns[:, None, :])


def test_a_missing_package_is_named_where_it_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kornia", None)
    check_installed("none")
    with pytest.raises(DependencyError, match=r"pip install kornia .*extra learn"):
        check_installed("render")


BLOCKS = [[0, 1], [2, 3]]


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("blocks", [[], BLOCKS])
def test_the_loss_of_each_head_is_computed_where_the_network_is(
    blocks: Sequence[Sequence[int]], periodic: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def matching(gain: Tensor) -> Tensor:  # theirs needs the numbers
        return torch.arange(2, device=gain.device).expand(len(gain), -1)

    monkeypatch.setattr(sets, "_matching", matching)
    network = Network((32, 32), [periodic] * 5, blocks).to("meta")
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
    return Network((32, 32), periodic, BLOCKS if kind == "set" else [])


def trainings(kind: str, augment: str = "none") -> list[Training]:
    """The same on a GPU and on the CPU; images are noise, but those of an emulator are gray."""
    rng = np.random.default_rng(0)
    x, images = rng.random((640, 5)), rng.integers(0, 256, (640, 32, 32, 3), dtype=np.uint8)
    if kind == "emulator":
        images[:] = np.rint(255 * x[:, :4].mean(axis=1))[:, None, None, None]
    networks = [made(kind).to(device) for device in ("cuda", "cpu")]
    return [Training(network, x, images, 1, augment=augment) for network in networks]


@pytest.mark.gpu
@pytest.mark.parametrize("head", ["autoregressive", "set"])
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
@pytest.mark.parametrize("kind", ["autoregressive", "set", "emulator"])
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
def test_a_model_that_was_learned_there_computes_on_the_processor() -> None:
    model = learn(disk, SPACE, renders=1200, size=SIDE, passes=6, device="cuda")
    assert model.network.device.type == "cpu"
    assert model.report.nll < -1.0
    assert model.sample(disk({"x": 0.3, "y": 0.6, "gray": 0.5}), 4).shape == (4, 4)


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
