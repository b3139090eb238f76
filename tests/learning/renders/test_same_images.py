"""Images of two renderers are not learned together, whatever the source says."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins.cli import main
from fide_plugins.errors import OptionError, RenderError
from fide_plugins.learning import Model, learn, renders as identity
from fide_plugins.learning.rendering import fill
from fide_plugins.learning.renders import SHARD, RenderStore, as_renderer, check_images
from fide_plugins.renderers import CommandRenderer
from fide_plugins.space import Float, Space
from fide_plugins.types import Float64
from tests.learning.conftest import SIDE

REFUSED = r"the renderer's images are not those in .*they differ by .* of 255 on average"


class Scene:
    """Gray gradient by two numbers; counts its renders.

    shift: of all grays.  noise: standard deviation, of other numbers for each render.
    source: stands for its text, which may have changed.  seed: of the noise.
    """

    name = "scene"

    def __init__(
        self,
        shift: float = 0.0,
        noise: float = 0.0,
        source: str = "1",
        version: str | None = None,
        seed: int = 0,
    ) -> None:
        self.fingerprint: str | None = f"text:{source}"
        self.version, self.renders = version, 0
        self._shift, self._noise = shift, noise
        self._rng = np.random.default_rng(seed)

    def __call__(self, x: Float64) -> Float64:
        self.renders += 1
        image = np.outer(np.linspace(0.3, x[0], SIDE), np.linspace(0.3, x[1], SIDE))
        noise = self._noise * self._rng.standard_normal((SIDE, SIDE))
        return np.clip(0.2 + 0.3 * image + self._shift + noise, 0, 1)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return tmp_path / "m.fide"


def learned(render: object, model: Path, renders: int = 100, **more: Any) -> Model:
    space = None if hasattr(render, "render") else more.pop("space", 2)
    return learn(render, space, renders=renders, size=SIDE, passes=1, out=model, **more)


def contents(model: Path) -> dict[str, bytes]:
    """All files of a folder of renders."""
    return {path.name: path.read_bytes() for path in Path(f"{model}.renders").iterdir()}


@pytest.mark.parametrize("shift", [0.0, 0.4 / 255, -0.4 / 255])
def test_renders_are_added_to_those_of_the_same_images(model: Path, shift: float) -> None:
    """Also where another processor rounds otherwise."""
    learned(Scene(), model)
    again = Scene(shift, source="with a comment")
    assert learned(again, model, 200).report.renders == 196
    assert again.renders == 1 + 4 + 100  # the first shows the shape


@pytest.mark.parametrize(("pixels", "equal"), [(0, True), (16, True), (17, False)])
def test_an_edge_may_fall_into_the_next_pixel(pixels: int, equal: bool) -> None:
    """As another processor may put it: 16 of 16,384 pixels are one in a thousand."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 100, (4, 64, 64, 3), dtype=np.uint8)
    moved = images.reshape(-1, 3).astype(np.float64)
    moved[rng.choice(len(moved), pixels, replace=False)] += 100
    assert identity._equal(moved.reshape(images.shape), images) is equal


@pytest.mark.parametrize("source", ["1", "2"])
@pytest.mark.parametrize(
    ("before", "now"),
    [
        ({}, {"shift": 0.01}),
        ({"noise": 0.05}, {"shift": 0.3, "noise": 0.05}),
        ({"noise": 0.1}, {"shift": 0.1, "noise": 0.1}),  # below the noise of a pixel
        ({"noise": 0.05}, {}),
    ],
)
def test_renders_are_not_added_to_those_of_other_images(
    model: Path, before: dict[str, Any], now: dict[str, Any], source: str
) -> None:
    """Also where the source is as it was, and something that it reads has changed."""
    learned(Scene(**before), model)
    there = contents(model)
    with pytest.raises(OptionError, match=f"{REFUSED}.*delete the folder, or learn into another"):
        learned(Scene(**now, source=source, seed=1), model, 200)
    assert contents(model) == there


@pytest.mark.parametrize("failing", [0.05, 0.2, 0.4])
@pytest.mark.parametrize(("noise", "rounding"), [(0.0, 0.0), (0.0, 0.4 / 255), (0.05, 0.0)])
def test_renders_that_fail_now_and_then_are_no_change(
    tmp_path: Path, noise: float, rounding: float, failing: float
) -> None:
    store = RenderStore(tmp_path, {"dim": 2, "size": [SIDE, SIDE], "seed": 0})
    fill(store, as_renderer(Scene(noise=noise), 2), 100)
    for shift, same in ((rounding, True), (0.3, False)):
        refused = 0
        for seed in range(1, 21):
            luck, scene = np.random.default_rng(seed), Scene(shift, noise, seed=seed)

            def unlucky(x: Float64, luck: Any = luck, scene: Scene = scene) -> Float64:
                if luck.random() < failing:
                    raise ValueError("no license")
                return scene(x)

            try:
                check_images(store, as_renderer(unlucky, 2), more=True)
            except OptionError:
                refused += 1
        assert refused == (0 if same else 20)


@pytest.mark.parametrize("renders", [100, 200])
@pytest.mark.parametrize("source", ["1", "2", None])
def test_a_version_that_is_stated_for_the_first_time_is_that_of_the_renders(
    model: Path, renders: int, source: str | None
) -> None:
    """If its images are, whatever is known of the source; from then on it counts."""
    learned(Scene(), model)
    other = Scene(0.3, version="1")
    other.fingerprint = None if source is None else f"text:{source}"
    with pytest.raises(OptionError, match=REFUSED):
        learned(other, model, renders)
    assert learned(Scene(version="1"), model, renders).version == "1"
    with pytest.raises(OptionError, match="its version is '1', not '2'"):
        learned(Scene(version="2"), model, 300)


def test_a_source_that_cannot_be_read_leaves_the_fingerprint(model: Path) -> None:
    """Otherwise a later change would not be noticed."""
    learned(Scene(), model)
    unread = Scene()
    unread.fingerprint = None
    learned(unread, model, 200)
    with pytest.raises(OptionError, match=REFUSED):
        learned(Scene(0.3, source="2"), model, 200)


def test_noise_is_no_change(model: Path) -> None:
    learned(Scene(noise=0.1), model)
    again = Scene(noise=0.1, source="2", seed=1)
    assert learned(again, model, 200).report.renders == 196
    assert again.renders == 1 + 4 + 32 + 100


def test_the_noise_of_whole_images_is_no_change(tmp_path: Path) -> None:
    """One number an image: the least that can be known of noise."""

    class Exposed(Scene):
        """Each render has an exposure of its own."""

        def __init__(self, seed: int) -> None:
            super().__init__()
            self._rng = np.random.default_rng(seed)

        def __call__(self, x: Float64) -> Float64:
            return super().__call__(x) + 0.1 * self._rng.random()

    store = RenderStore(tmp_path, {"dim": 2, "size": [SIDE, SIDE], "seed": 0})
    fill(store, as_renderer(Exposed(0), 2), 100)
    refused = 0
    for seed in range(1, 41):
        try:
            check_images(store, as_renderer(Exposed(seed), 2), more=True)
        except OptionError:
            refused += 1
    assert refused <= 2  # far less than one is to be expected
    with pytest.raises(OptionError, match=REFUSED):
        check_images(store, as_renderer(Scene(0.5), 2), more=True)


def test_seeded_noise_is_the_same_again(model: Path) -> None:
    class Seeded:
        """Nothing but noise, by the seeds that it gets."""

        dim, name, renders = 2, "seeded", 0

        def render(self, X: Float64, seed: Any = None) -> list[Float64]:
            self.renders += len(X)
            seeds = [0] * len(X) if seed is None else seed
            return [np.random.default_rng(s).random((SIDE, SIDE)) for s in seeds]

    learned(Seeded(), model)
    again = Seeded()
    learned(again, model, 300)
    assert again.renders == 1 + 4 + 200


def test_nothing_is_rendered_again_where_only_training_goes_on(model: Path) -> None:
    learned(Scene(), model)
    for scene in (Scene(), Scene(0.3)):  # the source is as it was
        learned(scene, model)
        assert scene.renders == 1


def test_training_does_not_go_on_with_images_of_another_source(model: Path) -> None:
    learned(Scene(), model)
    with pytest.raises(OptionError, match=REFUSED):
        learned(Scene(0.3, source="2"), model)
    mended = Scene(source="3")  # a comment
    learned(mended, model)
    assert mended.renders == 1 + 4
    again = Scene(source="3")
    learned(again, model)
    assert again.renders == 1  # that source is known now


def test_a_version_vouches_for_a_changed_source_but_not_for_images_that_are_mixed(
    model: Path,
) -> None:
    learned(Scene(version="1"), model)
    other = Scene(0.3, source="2", version="1")
    learned(other, model)
    assert other.renders == 1
    with pytest.raises(OptionError, match=REFUSED):
        learned(other, model, 200)


def test_a_renderer_that_fails_now_says_so(model: Path) -> None:
    def broken(x: Float64) -> Float64:
        if x[0] != 0.5:
            raise ValueError("no light")
        return scene(x)

    scene = Scene()
    broken.__name__ = scene.name
    learned(scene, model)
    there = contents(model)
    with pytest.raises(RenderError, match="failed for most parameters .*: ValueError: no light"):
        learned(broken, model, 200)
    assert contents(model) == there


def test_a_renderer_that_always_failed_binds_nobody(model: Path) -> None:
    class Broken(Scene):
        def __call__(self, x: Float64) -> Float64:
            if x[0] != 0.5:
                raise ValueError("no light")
            return super().__call__(x)

    with pytest.raises(RenderError):
        learned(Broken(version="1"), model)
    assert learned(Scene(version="2"), model, seed=3).version == "2"


def test_two_calls_at_once_do_not_mix_their_renders(tmp_path: Path) -> None:
    settings = {"dim": 2, "size": [SIDE, SIDE], "seed": 0}
    one, other = (RenderStore(tmp_path, {**settings, "seed": seed}) for seed in (0, 1))
    same, images = RenderStore(tmp_path, settings), [np.zeros((SIDE, SIDE, 3), np.uint8)] * SHARD
    one.write(0, images)
    same.write(1, images)
    with pytest.raises(OptionError, match="holds other renders: its seed is 0, not 1"):
        other.write(2, images)
    assert {path.name for path in tmp_path.iterdir()} == {"000000.npz", "000001.npz", "settings"}


def test_settings_that_were_lost_are_those_of_the_next_call(model: Path) -> None:
    learned(Scene(), model)
    (Path(f"{model}.renders") / "settings").unlink()
    learned(Scene(), model)
    with pytest.raises(OptionError, match="holds other renders: its seed is 0, not 1"):
        learned(Scene(), model, seed=1)


def test_renders_that_failed_are_not_tried_again(model: Path) -> None:
    scene = Scene()

    def fragile(x: Float64) -> Float64:
        if x[0] < 0.3:
            raise ValueError("no such thing")
        return scene(x)

    assert learned(fragile, model, 400).report.failed > 50
    assert learned(fragile, model, 500).report.failed > 50


def test_a_second_round_is_of_the_same_images_as_the_first(model: Path, tmp_path: Path) -> None:
    learned(Scene(), model)
    second: dict[str, Any] = {"after": model, "picture": Scene()(np.array([0.3, 0.8]))}
    for version in (None, "2"):  # a refused call binds nobody, not even to its version
        with pytest.raises(OptionError, match=REFUSED):
            learned(Scene(0.3, version=version), tmp_path / "second", **second)
        assert not contents(tmp_path / "second")
    assert learned(Scene(version="1"), tmp_path / "second", **second).report.renders == 196
    again = Scene(version="1")  # the first round had none: its images were compared
    learned(again, tmp_path / "second", 200, **second)
    assert again.renders == 1 + 4 + 4 + 100


PROGRAM = """
import sys
pixels = " ".join(str(round(float(sys.argv[2]) * i + {shift})) for i in range(256))
open(sys.argv[1], "w").write("P2 16 16 255 " + pixels)
"""


@pytest.mark.thorough
def test_a_program_that_has_changed_is_noticed(tmp_path: Path) -> None:
    """Its command line is what it was."""
    file = tmp_path / "draw.py"
    program = CommandRenderer(f"{sys.executable} -S -E {file} {{out:.ppm}} {{x}}", SPACE)
    renderer = as_renderer(program, SPACE)
    store = RenderStore(tmp_path / "m", {"dim": 1, "size": [SIDE, SIDE], "seed": 0})
    file.write_text(PROGRAM.format(shift=0))
    fill(store, renderer, 100)
    file.write_text(PROGRAM.format(shift="0 * 1"))
    check_images(store, renderer, more=True)
    file.write_text(PROGRAM.format(shift=3))
    with pytest.raises(OptionError, match=REFUSED):
        check_images(store, renderer, more=True)


SPACE = Space(x=Float(0.1, 0.9))
SCENE = """
import numpy as np
from fide_plugins import Float, Space

space = Space(left=Float(0, 1), right=Float(0, 1))


def render(params):
    return np.repeat(np.linspace(params["left"], params["right"], 16)[None], 16, axis=0)
"""


def test_the_command_goes_on_or_says_what_differs(
    empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """States of a file lie in folders, as a file is imported once a process."""

    def command(state: str, scene: str, *words: object) -> tuple[int, str]:
        file = empty_folder / state / "scene.py"
        file.parent.mkdir()
        file.write_text(scene)
        first = ("learn", f"{file}:render", "--size", 16, "--passes", 1, "--out", "m.fide")
        code = main([str(word) for word in (*first, "--renders", *words)])
        return code, capsys.readouterr().err

    assert command("first", SCENE, 100)[0] == 0
    code, errors = command("commented", SCENE + "# a comment\n", 200, "--resume")
    assert code == 0 and "change" not in errors
    code, errors = command("darker", SCENE.replace("[None]", "[None] * 0.9"), 300, "--resume")
    assert code == 2 and errors.count("\n") == 1
    assert "the renderer's images are not those in m.fide.renders" in errors
