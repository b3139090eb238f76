"""What renders, and whether it is what rendered before."""

from __future__ import annotations

import sys
import warnings
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import run as harness
from fide_lab.run.task import RendererTask
from fide_plugins import fit
from fide_plugins.cli import main
from fide_plugins.errors import ImageError, OptionError, RenderError
from fide_plugins.learning import Model, learn, renders as identity
from fide_plugins.learning.rendering import fill
from fide_plugins.learning.renders import SHARD, Pixels, RenderStore, as_renderer, check_images
from fide_plugins.renderers import CommandRenderer
from fide_plugins.space import Float, Space
from fide_plugins.types import Float64
from tests.learning.conftest import SIDE

WIDTH = 16


def plain(x: Float64) -> Float64:
    """Gray gradient by two numbers."""
    return np.outer(np.linspace(0, x[0], WIDTH), np.linspace(0, x[1], WIDTH))


class Task:
    """A task that renders by a function of one point.

    most: points of a batch that it can render.
    """

    dim, name = 2, "task"

    def __init__(self, render: Any, most: int) -> None:
        self._render, self._most = render, most

    def render(self, X: Float64) -> Any:
        if len(X) > self._most:
            raise MemoryError("too many")
        return [self._render(x) for x in X]


ONE_BY_ONE = ["function", "points of a task", "own renderer as a task"]
WAYS = [*ONE_BY_ONE, "batches of a task"]


def way(render: Any, how: str) -> Any:
    """One of the ways in which a renderer may be given."""
    if how == "function":
        return render
    if how == "own renderer as a task":
        return RendererTask("task", render, 2)
    return Task(render, 1 if how == "points of a task" else 100)


def renders(source: Any, folder: Path) -> tuple[Float64, Pixels]:
    """A shard, from disk."""
    store = RenderStore(folder, {"dim": 2, "size": [WIDTH, WIDTH], "seed": 0})
    fill(store, as_renderer(source, 2), 100)
    return store.read(100)


@pytest.mark.parametrize("how", ONE_BY_ONE)
def test_all_images_may_be_drawn_into_one_array(how: str, tmp_path: Path) -> None:
    buffer = np.empty((WIDTH, WIDTH))

    def reusing(x: Float64) -> Float64:
        buffer[:] = plain(x)
        return buffer

    found = renders(way(reusing, how), tmp_path / "found")
    expected = renders(plain, tmp_path / "expected")
    np.testing.assert_array_equal(found[1], expected[1])


@pytest.mark.parametrize("how", ONE_BY_ONE)
def test_full_images_are_not_kept(how: str, tmp_path: Path) -> None:
    there: list[weakref.ref[Float64]] = []
    most = 0

    def large(x: Float64) -> Float64:
        nonlocal most
        image = np.full((4 * WIDTH, 4 * WIDTH), x[0])
        there.append(weakref.ref(image))
        most = max(most, sum(each() is not None for each in there))
        return image

    renders(way(large, how), tmp_path)
    assert len(there) == 100 and most <= 2


@pytest.mark.parametrize("how", WAYS)
def test_a_renderer_may_change_its_argument(how: str, tmp_path: Path) -> None:
    def careless(x: Float64) -> Float64:
        image = plain(x)
        x *= 0.5
        return image

    x, images = renders(way(careless, how), tmp_path / "found")
    expected = renders(plain, tmp_path / "expected")
    np.testing.assert_array_equal(x, expected[0])
    np.testing.assert_array_equal(images, expected[1])


@pytest.mark.parametrize("how", WAYS)
@pytest.mark.parametrize("fails", ["raises", "exits", "is no image"])
def test_a_renderer_may_fail_in_the_middle_of_the_space(how: str, fails: str) -> None:
    def singular(x: Float64) -> Float64:
        if x[0] != 0.5:
            return plain(x)
        if fails == "raises":
            raise ZeroDivisionError
        if fails == "exits":
            sys.exit("no light")
        return np.full((WIDTH, WIDTH), np.nan)

    assert as_renderer(way(singular, how), 2).first_shape() == ((WIDTH, WIDTH), False)


@pytest.mark.parametrize("how", WAYS)
def test_a_renderer_that_fails_everywhere_says_what_happened_in_the_middle(how: str) -> None:
    def lightless(x: Float64) -> Float64:
        sys.exit(f"no light at {x[0]}")

    def endless(x: Float64) -> Float64:
        return np.full((WIDTH, WIDTH), np.inf)

    why = "in the middle of the space, and at 4 other points: SystemExit: no light at 0.5$"
    with pytest.raises(RenderError, match=why):
        learn(way(lightless, how), 2)
    name = "endless" if how == "function" else "task"
    with pytest.raises(ImageError, match=f"the image of {name} .*inf"):
        learn(way(endless, how), 2)


@pytest.mark.parametrize("how", WAYS)
def test_a_render_that_exits_has_failed(how: str, tmp_path: Path) -> None:
    def fragile(x: Float64) -> Float64:
        if x[0] < 0.2:
            sys.exit(1)
        return plain(x)

    x, _ = renders(way(fragile, how), tmp_path)
    assert 50 < len(x) < 100 and x[:, 0].min() >= 0.2


def test_an_image_that_is_none_is_called_the_renderers(tmp_path: Path) -> None:
    def odd(x: Float64) -> Any:
        return plain(x) if x[0] == 0.5 else np.zeros(3)

    with pytest.raises(RenderError, match="the first one: the image of odd must have axes"):
        learn(odd, 2, renders=500, size=WIDTH)


@pytest.mark.parametrize("how", WAYS)
def test_images_of_another_aspect_have_failed(how: str) -> None:
    """They would be stretched; those of another size alone are taken."""

    def cropped(x: Float64) -> Float64:
        if x[0] < 0.2:
            return plain(x)[: WIDTH // 2]
        return plain(x).repeat(2, axis=0).repeat(2, axis=1) if x[0] < 0.4 else plain(x)

    report = learn(way(cropped, how), 2, renders=200, size=WIDTH, passes=1).report
    x = [np.random.default_rng((0, shard)).random((100, 2)) for shard in range(2)]
    assert report.failed == (np.concatenate(x)[:, 0] < 0.2).sum()


def test_a_renderer_whose_images_differ_in_aspect_says_so() -> None:
    def turned(x: Float64) -> Float64:
        return plain(x)[: WIDTH // 2] if x[0] == 0.5 else plain(x)

    why = r"image of turned has 16 x 16 pixels \(width x height\), and the first one had 16 x 8"
    with pytest.raises(RenderError, match=why):
        learn(turned, 2, renders=500, size=WIDTH)


ARGUMENTS: dict[str, Any] = {"renders": 100, "size": SIDE, "passes": 1}


class Gradient:
    """Gray gradient by two numbers; counts its renders."""

    name = "gradient"

    def __init__(self, version: str | None = None, fingerprint: str | None = "own:1") -> None:
        self.version, self.fingerprint, self.renders = version, fingerprint, 0

    def __call__(self, x: Float64) -> Float64:
        self.renders += 1
        return np.outer(np.linspace(0, x[0], SIDE), np.linspace(0, x[1], SIDE))


PICTURE = Gradient()(np.array([0.3, 0.8]))


def fitted(render: Gradient, model: object) -> None:
    """Fit the picture, by a model that has learned too little to know it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the model of 'gradient' has learned nothing like")
        fit(render, PICTURE, 2, budget=5, workers=0, seed=0, learned=model)


def run(render: Gradient, model: object) -> None:
    """As `fitted`, by the loop of experiments."""
    task = RendererTask("gradient", render, 2)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the model of 'gradient' has learned nothing like")
        harness.run(task, budget=5, options={"learned": model})


def test_the_version_is_the_one_that_the_renderer_states(tmp_path: Path) -> None:
    file = tmp_path / "m"
    learn(Gradient("2"), 2, out=file, **ARGUMENTS)
    assert Model.load(file).version == "2"
    assert learn(Gradient("2"), 2, version="2", **ARGUMENTS).version == "2"
    assert learn(Gradient(), 2, version="3", **ARGUMENTS).version == "3"
    with pytest.raises(OptionError, match="its version is '2', not '3'"):
        learn(Gradient("3"), 2, out=file, **ARGUMENTS)


@pytest.mark.parametrize(
    ("own", "version", "message"),
    [
        ("1", "2", "version is '2', and the renderer gradient states '1': leave out version"),
        (None, 2, "version is a text such as '2', or None, not 2"),
        (2, None, "the version of gradient is a text such as '2', or None, not 2"),
    ],
)
def test_a_version_that_does_not_fit_is_refused_before_a_render(
    own: Any, version: Any, message: str
) -> None:
    render = Gradient(own)
    with pytest.raises(OptionError, match=message):
        learn(render, 2, version=version, **ARGUMENTS)
    assert render.renders == 0


@pytest.mark.parametrize("search", [fitted, run])
def test_a_model_of_another_version_is_refused(
    search: Callable[[Gradient, object], None], tmp_path: Path
) -> None:
    model = learn(Gradient("1"), 2, out=tmp_path / "m", **ARGUMENTS)
    for learned in (model, tmp_path / "m"):
        render = Gradient("2")
        with pytest.raises(OptionError, match="learned version '1' of 'gradient'.*version '2'"):
            search(render, learned)
        assert render.renders == 0


@pytest.mark.parametrize("search", [fitted, run])
@pytest.mark.parametrize(
    ("learned", "here", "warned"),
    [("1", "1", False), ("1", None, True), (None, "1", True), (None, None, True)],
)
def test_a_changed_source_is_a_warning_where_no_version_vouches_for_it(
    search: Callable[[Gradient, object], None], learned: str | None, here: str | None, warned: bool
) -> None:
    model = learn(Gradient(learned), 2, **ARGUMENTS)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        search(Gradient(here, "own:2"), model)
    messages = [str(each.message) for each in caught]
    assert messages == ["the model has learned 'gradient', " + CHANGED] * warned
    assert {each.filename for each in caught} <= {__file__}  # the call, not our own files


CHANGED = (
    "and that is not what renders here, or it was changed since; learn it again if its images are "
    "others now"
)

SCENE = """
import numpy as np
from fide_plugins import Float, Space

space = Space(left=Float(0, 1), right=Float(0, 1))


def render(params):
    return np.repeat(np.linspace(params["left"], params["right"], 16)[None], 16, axis=0)
"""


def fide(*words: object) -> int:
    return main([str(word) for word in words])


@pytest.fixture
def versioned(empty_folder: Path) -> Callable[[str], str]:
    """Writes a scene of some version into a folder of its own; returns the reference."""

    def write(version: str) -> str:
        folder = empty_folder / f"v{version}"
        folder.mkdir(exist_ok=True)
        text = f"{SCENE}\n\nrender.version = {version!r}  # {len(list(folder.parent.iterdir()))}\n"
        (folder / "scene.py").write_text(text)
        return f"v{version}/scene.py:render"

    return write


def test_commands_refuse_a_model_of_another_version(
    versioned: Callable[[str], str], capsys: pytest.CaptureFixture[str]
) -> None:
    from PIL import Image

    Image.new("L", (16, 16), 100).save("t.png")
    learned = ("learn", versioned("1"), "--size", 16, "--passes", 1, "--renders", 100)
    assert fide(*learned, "--out", "m.fide") == 0
    assert Model.load("m.fide").version == "1"
    assert fide(*learned, "--out", "n.fide", "--version", "9") == 2
    assert "version is '9', and the renderer scene.py:render states '1'" in capsys.readouterr().err
    other = versioned("2")
    for words in (
        ("fit", "t.png", "--renderer", other, "--workers", 0, "--learned", "m.fide"),
        ("run", other, "--learned", "m.fide"),
        ("compare", other, "--optimizers", "cma,fide:learned=m.fide", "--seeds", 1),
    ):
        assert fide(*words, "--budget", 20, "--out", "r") == 2
        error = capsys.readouterr().err
        assert "the model has learned version '1' of 'scene.py:render'" in error
        assert error.count("\n") == 1 and not Path("r").exists()


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
