"""A model and a renderer that are not of one another are noticed before anything is rendered."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import run as harness
from fide_lab.run.task import RendererTask
from fide_plugins import fit
from fide_plugins.cli import main
from fide_plugins.errors import OptionError
from fide_plugins.learning import Model, learn
from fide_plugins.types import Float64
from tests.learning.conftest import SIDE

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
