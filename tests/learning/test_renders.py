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
from fide_plugins.learning import Model, learn
from fide_plugins.learning.rendering import fill
from fide_plugins.learning.renders import Pixels, RenderStore, as_renderer
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
def test_images_of_another_aspect_have_failed(how: str) -> None:
    """They would be stretched; those of another size alone are taken."""

    def cropped(x: Float64) -> Float64:
        if x[0] < 0.2:
            return plain(x)[: WIDTH // 2]
        return plain(x).repeat(2, axis=0).repeat(2, axis=1) if x[0] < 0.4 else plain(x)

    report = learn(way(cropped, how), 2, renders=200, size=WIDTH, passes=1).report
    x = [np.random.default_rng((0, shard)).random((100, 2)) for shard in range(2)]
    assert report.failed == (np.concatenate(x)[:, 0] < 0.2).sum()


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
    for other in ("3", None):
        with pytest.raises(OptionError, match=f"its version is '2', not {other!r}"):
            learn(Gradient(other), 2, out=file, **ARGUMENTS)
    wrong: Any = Gradient(2)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="the version of gradient is a text such as '2', or None"):
        learn(wrong, 2, **ARGUMENTS)
    assert wrong.renders == 0


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
    capsys.readouterr()
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


def test_a_changed_source_is_a_warning_where_renders_are_there(tmp_path: Path) -> None:
    """Once for each change, and not where a version says which images it makes."""
    file = tmp_path / "m"
    learn(Gradient(), 2, out=file, **ARGUMENTS)
    edited = Gradient(fingerprint="own:2")
    with pytest.warns(RuntimeWarning, match="changed since .* delete that folder if its images"):
        learn(edited, 2, out=file, **ARGUMENTS)
    assert edited.renders == 1  # the first shows the shape
    learn(edited, 2, out=file, **ARGUMENTS | {"renders": 200})
    assert edited.renders == 1 + 1 + 100
    learn(Gradient("1"), 2, out=tmp_path / "n", **ARGUMENTS)
    learn(Gradient("1", fingerprint="own:2"), 2, out=tmp_path / "n", **ARGUMENTS)
