"""Renders are pasted onto other pictures while they are learned, again in each pass."""

from __future__ import annotations

import threading
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from fide_plugins import FIDE
from fide_plugins.cli import main
from fide_plugins.errors import ImageError, OptionError
from fide_plugins.learning import LearnProgress, Model, learn
from fide_plugins.learning.clutter import Clutter, clutter_of, generated
from fide_plugins.learning.networks import Network
from fide_plugins.learning.training import Training
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.images import save

SIDE = 16
_GRID = (np.arange(SIDE) + 0.5) / SIDE


def disk(x: Float64) -> tuple[Float32, Float32]:
    """Gray disk at (x, y) on black, and its coverage."""
    away = np.hypot(_GRID[None] - x[0], _GRID[:, None] - x[1])
    coverage = (1 / (1 + np.exp((away - 0.25) * 40))).astype(np.float32)
    return np.full((SIDE, SIDE), 0.8, np.float32), coverage


def rgba(x: Float64) -> Float32:
    image, coverage = disk(x)
    return np.dstack([image, image, image, coverage])


def opaque(x: Float64) -> Float32:
    return disk(x)[1]


def never(x: Float64) -> Float64:
    raise AssertionError("nothing is rendered before the arguments are checked")


def render_of(gray: float, n: int = 64) -> Tensor:
    """Renders (n, 4, 16, 16) that cover a square of 6 x 6 pixels."""
    render = torch.zeros(n, 4, SIDE, SIDE)
    render[:, :3, 5:11, 5:11], render[:, 3, 5:11, 5:11] = gray, 1.0
    return render


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


BACKGROUND = np.linspace(0.2, 0.4, 40 * 50 * 3, dtype=np.float32).reshape(40, 50, 3)
QUICK: dict[str, Any] = {"renders": 200, "size": SIDE, "passes": 1, "augment": "none"}


def test_a_background_shows_where_the_render_covers_nothing() -> None:
    clutter = clutter_of([BACKGROUND], False, 0)
    assert clutter is not None
    images = clutter.composed(render_of(0.8), seeded())
    torch.testing.assert_close(images[:, :, 5:11, 5:11], torch.full((64, 3, 6, 6), 0.8))
    outside = torch.ones(SIDE, SIDE, dtype=torch.bool)
    outside[5:11, 5:11] = False
    assert images[..., outside].amax() < 0.72 and images[..., outside].std() > 0.05
    assert (images[0] != images[1]).any()


def test_the_same_generator_composes_the_same_and_another_pass_does_not() -> None:
    clutter = clutter_of("generated", None, 0)
    assert clutter is not None
    one, two, other = (clutter.composed(render_of(0.8), seeded(seed)) for seed in (1, 1, 2))
    assert torch.equal(one, two) and not torch.equal(one, other)
    assert one.min() >= 0 and one.max() <= 1 and one.shape == (64, 3, SIDE, SIDE)


def test_rims_light_and_things_in_front_change_what_photographs_change() -> None:
    clutter = Clutter((np.full((32, 32, 3), 0.5, np.float32),), "gray")
    plain = clutter_of([np.full((32, 32, 3), 0.5, np.float32)], False, 0)
    assert plain is not None
    images, before = (one.composed(render_of(0.8, 400), seeded()) for one in (clutter, plain))
    middle, beside = images[:, :, 7:9, 7:9].mean((1, 2, 3)), images[:, :, 5:11, 4].mean((1, 2))
    assert middle.std() > 0.1  # light, things in front
    assert beside.std() > 1.2 * before[:, :, 5:11, 4].mean((1, 2)).std()  # rims, shadows
    assert (middle - 0.8).abs().median() < 0.15  # and most of the object is still seen


@pytest.mark.parametrize("seed", [0, 1])
def test_generated_backgrounds_are_pictures_and_the_same_for_a_seed(seed: int) -> None:
    pictures = generated(10, 48, seed)
    for one, two in zip(pictures, generated(10, 48, seed), strict=True):
        assert one.shape == (48, 48, 3) and one.dtype == np.float32
        assert one.min() >= 0 and one.max() <= 1
        np.testing.assert_array_equal(one, two)
    assert np.mean([picture.std() for picture in pictures]) > 0.08


def test_pairs_and_rgba_are_stored_with_their_coverage(tmp_path: Path) -> None:
    for name, render in {"pair": disk, "rgba": rgba}.items():
        learn(render, 2, out=tmp_path / name, backgrounds=[BACKGROUND], **QUICK)
    shard = [np.load(tmp_path / f"{name}.renders" / "000000.npz") for name in ("pair", "rgba")]
    (x, images), (_, same) = ((one["x"], one["images"]) for one in shard)
    assert images.shape == (100, SIDE, SIDE, 4)
    np.testing.assert_array_equal(images, same)
    color, coverage = disk(x[3])
    np.testing.assert_allclose(images[3, ..., 3] / 255, coverage, atol=1 / 255)
    np.testing.assert_allclose(images[3, ..., 0] / 255, color * coverage, atol=1 / 255)


def test_other_backgrounds_train_again_on_the_same_renders(tmp_path: Path) -> None:
    def note(at: LearnProgress) -> None:
        stages.append(at.stage)

    arguments: dict[str, Any] = {"out": tmp_path / "m", "on_progress": note, **QUICK}
    stages: list[str] = []
    first = learn(disk, 2, backgrounds="generated", **arguments)
    assert first.report.clutter == "generated backgrounds"
    assert "generated backgrounds" in str(Model.load(tmp_path / "m").report)
    stages.clear()
    again = learn(disk, 2, backgrounds="generated", **arguments)
    assert {"render", "train"}.isdisjoint(stages) and again.report.curve == first.report.curve
    other = learn(disk, 2, backgrounds=[BACKGROUND], **arguments)
    assert "train" in stages and "render" not in stages
    assert other.report.clutter == "1 background" and other.report.curve != first.report.curve


def test_an_interrupted_training_composes_the_same(tmp_path: Path) -> None:
    class Stop(BaseException):
        pass

    def stop(at: LearnProgress) -> None:
        if (at.stage, at.done) == ("train", 1):
            raise Stop

    arguments: dict[str, Any] = {**QUICK, "passes": 2, "backgrounds": "generated"}
    with pytest.raises(Stop):
        learn(disk, 2, out=tmp_path / "m", on_progress=stop, **arguments)
    resumed, whole = learn(disk, 2, out=tmp_path / "m", **arguments), learn(disk, 2, **arguments)
    assert resumed.report.curve == whole.report.curve


def test_no_error_and_no_interruption_leaves_the_thread_that_makes_batches() -> None:
    class Failing(Clutter):
        def composed(self, renders: Tensor, generator: torch.Generator) -> Tensor:
            if threading.current_thread() is not threading.main_thread():
                raise ValueError("no batch")
            return super().composed(renders, generator)

    class Interrupted(Training):
        def _step(self, loss: Tensor) -> None:
            raise KeyboardInterrupt

    rng = np.random.default_rng(0)
    x, images = rng.random((200, 2)), rng.integers(0, 256, (200, 16, 16, 3), np.uint8)
    network = Network((16, 16), (False, False))
    before = threading.active_count()
    with pytest.raises(ValueError, match="no batch"):
        Training(network, x, images, 2, clutter=Failing((), "none")).run()
    with pytest.raises(KeyboardInterrupt):
        Interrupted(network, x, images, 2, clutter=Clutter((), "none")).run()
    assert threading.active_count() == before


def test_clutter_without_a_coverage_changes_light_and_what_is_in_front() -> None:
    model = learn(opaque, 2, clutter=True, **QUICK)
    assert model.report.clutter == "clutter without backgrounds"


def test_of_a_photograph_a_model_without_clutter_is_warned_of() -> None:
    plain, cluttered = learn(opaque, 2, **QUICK), learn(opaque, 2, clutter=True, **QUICK)
    photograph = opaque(np.array([0.4, 0.6]))
    with pytest.warns(RuntimeWarning, match="without clutter: learn one with backgrounds"):
        FIDE(2, photograph, learned=plain, photo=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        FIDE(2, photograph, learned=cluttered, photo=True)
        FIDE(2, photograph, learned=plain)


@pytest.mark.thorough
def test_what_was_learned_with_clutter_finds_the_object_in_clutter() -> None:
    arguments: dict[str, Any] = {"renders": 3000, "size": SIDE, "passes": 6}
    model = learn(disk, 2, backgrounds="generated", **arguments)
    plain = learn(opaque, 2, **arguments)
    x = np.array([0.3, 0.6])
    render = torch.from_numpy(np.round(255 * rgba(x))).permute(2, 0, 1)[None] / 255
    render[:, :3] *= render[:, 3:]
    clutter = clutter_of("generated", None, 1)
    assert clutter is not None
    pictures = clutter.composed(render.expand(40, -1, -1, -1), seeded()).permute(0, 2, 3, 1)

    def error(found: Model) -> float:
        middle = [np.median(found.sample(p.numpy(), 32), axis=0) for p in pictures]
        return float(np.median(np.abs(np.array(middle) - x).max(axis=1)))

    assert error(model) < 0.1 and error(model) < 0.7 * error(plain)
    assert np.mean([model.knows(p.numpy()) for p in pictures]) > 0.9


@pytest.mark.usefixtures("empty_folder")
def test_the_command_takes_backgrounds(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["learn", "robot", "--out", "m.fide", "--size", "16", "--backgrounds"]
    assert main([*words, "nowhere"]) == 2
    assert "there is no folder 'nowhere'" in capsys.readouterr().err.replace("\n", " ")
    assert main([*words, "generated"]) == 2
    assert "say what they draw" in capsys.readouterr().err.replace("\n", " ")


# -- what is refused -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"backgrounds": "nowhere"}, "there is no folder 'nowhere'"),
        ({"backgrounds": 3}, "a folder of pictures, a list of them or 'generated', not 3"),
        ({"backgrounds": []}, r"not \[\]"),
        ({"clutter": "yes"}, "clutter is True, False or None, not 'yes'"),
        ({"backgrounds": "generated", "emulator": True, "groups": [[0], [1]]}, "without clutter"),
    ],
)
def test_impossible_backgrounds_are_refused_before_anything_is_rendered(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises(OptionError, match=message):
        learn(never, 2, **options, **QUICK)


def test_a_folder_without_pictures_and_a_file_that_is_none_are_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(OptionError, match="has no picture"):
        learn(never, 2, backgrounds=tmp_path, **QUICK)
    (tmp_path / "broken.png").write_text("nothing")
    with pytest.raises(ImageError, match="broken"):
        learn(never, 2, backgrounds=tmp_path, **QUICK)
    (tmp_path / "broken.png").unlink()
    save(tmp_path / "good.png", BACKGROUND)
    clutter = clutter_of(tmp_path, None, 0)
    assert clutter is not None and clutter.name == "1 background"


def test_backgrounds_need_a_coverage_of_the_size_of_the_image() -> None:
    with pytest.raises(OptionError, match="say what they draw"):
        learn(opaque, 2, backgrounds="generated", **QUICK)
    with pytest.raises(ImageError, match=r"16 x 8 pixels .* and the image 16 x 16"):
        learn(lambda x: (disk(x)[0], disk(x)[1][:8]), 2, backgrounds="generated", **QUICK)
