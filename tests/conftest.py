"""What tests share: how cases are generated, a small renderer, weights as they are published."""

from __future__ import annotations

import gc
import io
import json
import os
import shutil
import signal
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, TextIO, TypeAlias

import hypothesis
import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from fide_plugins.cli import main
from fide_plugins.types import Float32, Float64

# The same cases every time, so that a change is judged by what it changes; a longer run
# (FIDE_CASES=1) looks for new ones.
hypothesis.settings.register_profile("same", derandomize=True, deadline=None)
if "FIDE_CASES" not in os.environ:
    hypothesis.settings.load_profile("same")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Nothing that is imported is ever garbage: the collector need not look for it in each test."""
    gc.disable()
    yield
    gc.freeze()
    gc.enable()


def pytest_configure(config: pytest.Config) -> None:
    """Hide the GPU from CUDA in tests that do not ask for it: they compare bits, and fork."""
    if "gpu" not in config.option.markexpr.replace("not gpu", ""):
        os.environ["CUDA_VISIBLE_DEVICES"] = ""


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("gpu") and not torch.cuda.is_available():
        pytest.skip("needs an NVIDIA GPU, and pytest -m gpu")


State: TypeAlias = dict[str, Tensor]

# Shapes of the convolutions as torchvision names them: number in `features`: (out, in, side).
ALEXNET = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)}
VGG19 = dict(
    zip(
        (0, 2, 5, 7, 10, 12, 14, 16, 19, 21, 23, 25, 28, 30, 32, 34),
        [(64, 3, 3), (64, 64, 3), (128, 64, 3), (128, 128, 3), (256, 128, 3)]
        + [(256, 256, 3)] * 3 + [(512, 256, 3)] + [(512, 512, 3)] * 7,
        strict=True,
    )
)  # fmt: skip
LPIPS = (64, 192, 384, 256, 256)  # channels
# Very small DINO networks, kind: class in transformers, its settings.
TINY: dict[str, Any] = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
DINO: dict[str, tuple[str, dict[str, Any]]] = {
    "dinov3": ("DINOv3ViT", {"patch_size": 16, "intermediate_size": 64, "num_register_tokens": 4}),
    "dinov2": ("Dinov2", {"patch_size": 14, "image_size": 56, "mlp_ratio": 2}),
    "dinov2 with registers": (
        "Dinov2WithRegisters",
        {"patch_size": 14, "image_size": 56, "mlp_ratio": 2, "num_register_tokens": 3},
    ),
}


SIDE = 16  # pixels of the small renderer's images


def soft_disk(X: Float64) -> Float32:
    """Disks (n, SIDE, SIDE, 3) at x, y = X[:, 0:2], of radius and color by the other columns.

    Columns beyond the sixth have no effect; missing ones are 0.5.
    """
    p = np.full((len(X), 6), 0.5)
    p[:, : X.shape[1]] = X[:, :6]
    grid = (np.arange(SIDE) + 0.5) / SIDE
    x, y, radius = (p[:, i, None, None] for i in range(3))
    distance = np.hypot(grid[None, None, :] - x, grid[None, :, None] - y)
    inside = 1 / (1 + np.exp((distance - 0.1 - 0.3 * radius) * 15))
    images: Float32 = (inside[..., None] * p[:, None, None, 3:]).astype(np.float32)
    return images


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A real browser, driven by Playwright."""
    names = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip(f"needs a browser, one of {', '.join(names)}")
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(autouse=True)
def _only_drawn_where_it_is_looked_at(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Write empty figures of runs and reports, but in tests marked `figures`.

    A run's summary takes 0.2 s and a report's charts 3 s, most of what a small run takes.
    """
    if request.node.get_closest_marker("figures") is None:
        for name in ("fide_lab.figures.summary", "fide_lab.report.plots.png"):
            monkeypatch.setattr(name, lambda *_, **more: EMPTY_PNG)


@pytest.fixture(autouse=True)
def _folders_of_modules_are_forgotten() -> Iterator[None]:
    """A user's file is imported with its folder, which stays in `sys.path`.

    Without this, each import, and each run that reads versions of packages, would search the
    folders of hundreds of earlier tests.
    """
    before = sys.path.copy()
    yield
    sys.path[:] = before


def empty_png() -> bytes:
    buffer = io.BytesIO()
    Image.new("L", (1, 1)).save(buffer, format="PNG")
    return buffer.getvalue()


EMPTY_PNG = empty_png()


@pytest.fixture
def render() -> Callable[[Float64], Float32]:
    return soft_disk


@pytest.fixture
def answer() -> Float64:
    return np.array([0.7, 0.35, 0.6, 0.9, 0.4, 0.2])


@pytest.fixture
def target(answer: Float64) -> Float32:
    image: Float32 = soft_disk(answer[None])[0]
    return image


@pytest.fixture
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder during the test."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def ends() -> Callable[[int], bool]:
    """Whether a process ends within a minute, or has; one that nobody waits for is a zombie (Z)."""
    return ended


def ended(pid: int) -> bool:
    until = time.monotonic() + 60
    while time.monotonic() < until:
        try:
            os.kill(pid, 0)
            status = Path(f"/proc/{pid}/stat")
            if status.exists() and status.read_text().rpartition(")")[2].split()[0] in "ZX":
                return True
        except (FileNotFoundError, ProcessLookupError):
            return True
        time.sleep(0.02)
    return False


@pytest.fixture(scope="session")
def counted_calls() -> Callable[[Counter[str]], AbstractContextManager[None]]:
    """A block in which calls of functions are counted, Python's and C's, as ``count["calls"]``.

    Unlike seconds, they depend on no other program, and on no disk.
    """
    return counting_calls


@contextmanager
def counting_calls(count: Counter[str]) -> Iterator[None]:
    def note(frame: object, event: str, argument: object) -> None:
        count["calls"] += event in ("call", "c_call")

    sys.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(None)


@pytest.fixture
def forked() -> Callable[[Callable[[], object]], str]:
    """What a function returns in a forked process, or its error, in words.

    A child that takes a minute is ended, and the test fails.
    """
    if not hasattr(os, "fork"):
        pytest.skip("no fork here")
    return in_child


def in_child(work: Callable[[], object]) -> str:
    def write(stream: TextIO) -> None:
        try:
            stream.write(repr(work()))
        except BaseException as error:
            stream.write(repr(error))

    child, pipe = started(write)
    with pipe:
        answer = pipe.read()
    assert os.waitpid(child, 0)[1] == 0, "the child hung"
    return answer


def started(work: Callable[[TextIO], int | None]) -> tuple[int, TextIO]:
    """Fork a process that does some work, whose exit code that returns.

    Returns its id, and the stream of what the work writes.  It is ended after a minute.
    """
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # forks with threads
        child = os.fork()
    if child == 0:
        signal.alarm(60)
        code: int | None = 70
        try:
            with os.fdopen(writing, "w", buffering=1) as stream:
                code = work(stream)
        finally:
            os._exit(code or 0)
    os.close(writing)
    return child, os.fdopen(reading)


class ForkedCommand:
    """`fide WORDS` with real signals and exit codes, in a fork, which has all imports already.

    stderr: what it says there.  What it writes to standard output is dropped.
    """

    def __init__(self, *words: object) -> None:
        def command(stderr: TextIO) -> int:
            signal.signal(signal.SIGINT, signal.default_int_handler)  # as in a terminal
            with redirect_stderr(stderr), redirect_stdout(io.StringIO()):
                return main([str(word) for word in words])

        self.pid, self.stderr = started(command)

    def wait_until(self, condition: Callable[[], object]) -> None:
        """Wait for something that the command does; fails where it ends before."""
        while not condition():
            assert os.waitpid(self.pid, os.WNOHANG) == (0, 0), self.stderr.read()
            time.sleep(0.005)

    def stop(self, signum: signal.Signals) -> tuple[int, str]:
        """Send a signal; returns the exit code, and what it says from then on."""
        os.kill(self.pid, signum)
        with self.stderr:
            said = self.stderr.read()
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1]), said


@pytest.fixture
def forked_command() -> type[ForkedCommand]:
    if not hasattr(os, "fork"):
        pytest.skip("no fork here")
    return ForkedCommand


def random_network(shapes: Mapping[Any, tuple[int, int, int]], seed: int) -> State:
    """Convolutions that keep the size of what they get, and the classifier that nobody needs."""
    generator = torch.Generator().manual_seed(seed)
    state: State = {}
    for name, (out, into, side) in shapes.items():
        scale = (2 / (into * side * side)) ** 0.5
        noise = torch.randn(out, into, side, side, generator=generator)
        state[f"features.{name}.weight"] = noise * scale
        state[f"features.{name}.bias"] = 0.1 * torch.randn(out, generator=generator)
    state["classifier.6.weight"] = torch.zeros(10, 4)
    return state


def random_heads() -> State:
    """Weights >= 0 of the layers' channels, as LPIPS has them."""
    generator = torch.Generator().manual_seed(9)
    return {
        f"lin{i}.model.1.weight": torch.rand(1, c, 1, 1, generator=generator)
        for i, c in enumerate(LPIPS)
    }


@pytest.fixture(scope="session")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache of PyTorch's with random weights for every file that there is a name for."""
    home = tmp_path_factory.mktemp("torch")
    checkpoints = home / "checkpoints"
    checkpoints.mkdir()
    torch.save(random_network(ALEXNET, 1), checkpoints / "alexnet-owt-7be5be79.pth")
    torch.save(random_network(VGG19, 3), checkpoints / "vgg19-dcbb9e9d.pth")
    torch.save(random_heads(), checkpoints / "lpips-v0.1-alex.pth")
    return home


@pytest.fixture
def cached_weights(published: Path) -> Iterator[Path]:
    """Folder with those files, in which weights are looked for during the test."""
    before = torch.hub.get_dir()
    torch.hub.set_dir(published)
    yield published / "checkpoints"
    torch.hub.set_dir(before)


@pytest.fixture
def no_weights(tmp_path: Path) -> Iterator[Path]:
    """Empty folder in which weights are looked for during the test."""
    before = torch.hub.get_dir()
    torch.hub.set_dir(tmp_path / "empty")
    yield tmp_path / "empty"
    torch.hub.set_dir(before)


@pytest.fixture(scope="session")
def dino_folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folders, by kind, of very small networks with random weights, saved by transformers."""
    transformers = pytest.importorskip("transformers")
    transformers.utils.logging.disable_progress_bar()
    folders: dict[str, Path] = {}
    for kind, (name, settings) in DINO.items():
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
