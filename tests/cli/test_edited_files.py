"""A file of the user that is edited before its run is resumed."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from .conftest import fide


def edit(file: Path, old: str, new: str) -> None:
    """Edit a module, as if the next process were to load it."""
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    for name, module in list(sys.modules.items()):
        if getattr(module, "__file__", None) == str(file):
            del sys.modules[name]


pytestmark = pytest.mark.filterwarnings("always:.*has changed since:RuntimeWarning")

RUN = ("run", "scene.py:render", "--target", "target.png", "--optimizer", "random", "--seed", 0)
FIT = ("fit", "target.png", "--renderer", "scene.py:render", "--workers", 0, "--seed", 0)


@pytest.mark.usefixtures("target")
@pytest.mark.parametrize("command", [RUN, FIT])
def test_resuming_names_a_renderer_that_was_edited_once(
    command: tuple[object, ...], scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = (*command, "--out", "out", "--budget")
    assert fide(*words, 10) == 0
    assert fide(*words, 20, "--resume") == 0
    assert "has changed" not in capsys.readouterr().err
    edit(scene, "far < 0.5", "far < 0.6")
    assert fide(*words, 30, "--resume") == 0
    assert (
        f"fide {command[0]}: scene.py has changed since the run in out" in capsys.readouterr().err
    )
    sources = json.loads(Path("out/run.json").read_text())["sources"]
    (versions,) = (found for name, found in sources.items() if name.startswith("scene.py"))
    assert len(versions) == 2
    assert fide(*words, 40, "--resume") == 0
    assert "has changed" not in capsys.readouterr().err
