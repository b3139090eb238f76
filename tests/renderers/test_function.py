"""A user's function, found by file or module and name."""

from __future__ import annotations

import os
import traceback
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from fide_plugins import Float, Space
from fide_plugins.errors import FideError, OptionError, RenderError
from fide_plugins.renderers import FunctionRenderer

SCENE = """
import os
import numpy as np
from fide_plugins import Float, Space

loaded_in = os.getpid()
size = 8
space = Space(gray=Float(0, 10))

def render(params):
    return np.full((size, size, 3), params["gray"] / 10)

def where(params):
    return loaded_in, os.getpid()

def of_x(x):
    return np.full((size, size, 3), x[0])

of_x.space = 2
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "my scene.py"
    path.write_text(SCENE)
    return path


def test_a_function_in_a_file_and_the_space_beside_it(scene: Path) -> None:
    renderer = FunctionRenderer(f"{scene}:render")
    assert renderer.space == Space(gray=Float(0, 10))
    np.testing.assert_array_equal(renderer({"gray": 5.0}), np.full((8, 8, 3), 0.5))
    assert renderer.name == "my scene.py:render"


def test_the_functions_own_space_comes_first_and_may_be_a_number(scene: Path) -> None:
    renderer = FunctionRenderer(f"{scene}:of_x")
    assert renderer.space == 2
    assert renderer(np.array([0.25, 0.5]))[0, 0, 0] == 0.25


def test_a_file_imports_its_neighbors_and_holds_dataclasses(tmp_path: Path) -> None:
    (tmp_path / "fide_test_neighbor.py").write_text("VALUE = 7")
    (tmp_path / "scene.py").write_text(
        "from __future__ import annotations\nfrom dataclasses import dataclass\n"
        "import fide_test_neighbor\n\n@dataclass\nclass Ball:\n    x: float\n\n"
        "def render(params):\n    return fide_test_neighbor.VALUE\n"
    )
    assert FunctionRenderer(f"{tmp_path}/scene.py:render")({}) == 7


def test_a_copy_in_a_spawned_process_loads_the_file_there_once(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(scene.parent)
    renderer = FunctionRenderer("my scene.py:where")
    monkeypatch.chdir("/")
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        pairs = [pool.submit(renderer, {}).result() for _ in range(3)]
    ((loaded_in, process),) = set(pairs)
    assert loaded_in == process != os.getpid()


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("nothing.py:render", "no file '/.*/nothing.py'; write FILE.py:NAME or module:NAME"),
        ("scen.py:render", "no file '/.*/scen.py'; did you mean 'scene.py'"),
        ("scene.py", "no renderer 'scene.py'.*; it has render, shade"),
        ("scene.py:", "no renderer 'scene.py:'; write FILE.py:NAME"),
        ("scene", "no renderer 'scene'; write FILE.py:NAME"),
        ("fide_no_such_module:render", "no module 'fide_no_such_module'"),
        ("scene.py:rendr", "'rendr' in .*scene.py must be .*it has render, shade"),
        ("scene.py:SIZE", "'SIZE' in .*scene.py must be a function.*it has render"),
    ],
)
def test_what_is_missing_is_named_with_what_is_there(
    reference: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("scene.py").write_text(
        "from math import sin\nSIZE = 4\ndef render(p): ...\ndef shade(p): ...\ndef _own(p): ...\n"
    )
    with pytest.raises(FideError, match=message):
        FunctionRenderer(reference)


def test_an_error_in_the_file_is_shown_whole(tmp_path: Path) -> None:
    path = tmp_path / "broken.py"
    path.write_text("def half(x):\n    return x / 0\n\nhalf(3)\n")
    with pytest.raises(FideError) as caught:
        FunctionRenderer(f"{path}:render")
    message = str(caught.value)
    assert "broken.py cannot be imported" in message
    assert "line 4" in message and "half(3)" in message and "in half" in message
    assert message.endswith("ZeroDivisionError: division by zero")
    shown = "".join(traceback.format_exception(caught.value))
    assert shown.count("in half\n") == 1  # the traceback of the file stands there once
    path.write_text("def half(x):\n    return x / 2\n")  # a mended file is loaded
    assert FunctionRenderer(f"{path}:half")(3) == 1.5


def test_a_file_that_ends_the_process_or_lacks_a_module_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "leaves.py"
    path.write_text("raise SystemExit(3)")
    with pytest.raises(FideError, match="cannot be imported.*\n.*\n.*\nSystemExit: 3"):
        FunctionRenderer(f"{path}:render")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(FideError, match="leaves cannot be imported.*\n.*\n.*\nSystemExit: 3"):
        FunctionRenderer("leaves:render")
    path.write_text("import fide_no_such_module")
    with pytest.raises(FideError, match="No module named 'fide_no_such_module'"):
        FunctionRenderer(f"{path}:render")


def test_an_exception_of_the_function_names_line_and_parameters(tmp_path: Path) -> None:
    path = tmp_path / "fails.py"
    path.write_text("def render(params):\n    return params['x'] / 0\n")
    with pytest.raises(RenderError) as caught:
        FunctionRenderer(f"{path}:render")({"x": 0.123456789, "beads": [{"y": 2.0}]})
    assert str(caught.value) == (
        f"render in {path} raised an exception\nwith the parameters x=0.123457, beads[0].y=2\n"
        f"  File \"{path}\", line 2, in render\n    return params['x'] / 0\n"
        "           ~~~~~~~~~~~~^~~\nZeroDivisionError: float division by zero"
    )


def test_a_file_that_changes_the_folder_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("moves.py").write_text("import os\nos.chdir('/')\nrender = dict")
    with pytest.raises(OptionError, match=r"os\.chdir.*__file__"):
        FunctionRenderer("moves.py:render")
    assert Path.cwd() == tmp_path
