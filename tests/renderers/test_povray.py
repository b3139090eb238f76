"""The example in POV-Ray, with the real program: from the shell, with `fit` and with Optuna."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_plugins import Space, images
from fide_plugins.cli import main
from fide_plugins.renderers import CommandRenderer

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "povray"
TRUTH: dict[str, Any] = {
    "azimuth": 25.0, "elevation": 18.0, "sun": -50.0, "sun_height": 42.0,
    "ball": {"x": 0.4, "z": -0.6}, "radius": 0.7, "red": 0.85, "green": 0.3, "roughness": 0.02,
    "columns": 6, "floor": "checker",
}  # fmt: skip
"""Parameters of target.png."""

pytestmark = [
    pytest.mark.skipif(shutil.which("povray") is None, reason="POV-Ray is not installed"),
    pytest.mark.skipif(not EXAMPLE.is_dir(), reason="the examples are not here"),
]


@pytest.fixture(autouse=True)
def _in_the_folder_of_the_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(EXAMPLE, tmp_path / "povray")
    monkeypatch.chdir(tmp_path / "povray")


def documented() -> list[str]:
    """Arguments of the command in docs/reference/own_renderer.md, at 32 x 32 pixels."""
    text = (ROOT / "docs" / "reference" / "own_renderer.md").read_text("utf-8")
    found = re.search(r"^    fide (fit target\.png .*?)\n\n", text, re.MULTILINE | re.DOTALL)
    assert found is not None
    return shlex.split(found[1])


def small() -> CommandRenderer:
    words = documented()
    template = words[words.index("--command") + 1].replace("+W96 +H96", "+W32 +H32")
    return CommandRenderer(template, Space.read("space.toml"))


def test_the_target_is_that_of_its_parameters() -> None:
    words = documented()
    render = CommandRenderer(words[words.index("--command") + 1], Space.read("space.toml"))
    picture = render(TRUTH)
    assert isinstance(picture, np.ndarray)  # another version of POV-Ray may round otherwise
    assert np.abs(picture - images.load("target.png")).mean() < 2 / 255


@pytest.mark.thorough
def test_the_documented_command_fits(capsys: pytest.CaptureFixture[str]) -> None:
    words = documented()
    words[words.index("--budget") + 1] = "10"
    assert main([*words, "--out", "out", "--json"]) == 0
    captured = capsys.readouterr()
    result = json.loads(captured.out.splitlines()[-1])
    assert (result["task"], result["evaluations"], result["failures"]) == ("povray", 10, 0)
    space = Space.read("space.toml")
    assert result["params"] == space.decode(result["x_best"])
    render = CommandRenderer(words[words.index("--command") + 1], space)
    again = np.asarray(render(result["params"]))  # the file decides what an image was rendered of
    assert np.square(again - images.load("target.png")).mean() == pytest.approx(result["mse"])
