"""A broken OpenCV is said to be broken, with the commands that mend it."""

from __future__ import annotations

import importlib
import importlib.metadata
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fide_plugins.cli import main
from fide_plugins.errors import DependencyError
from fide_plugins.runtime import machine

HERE = "fide_plugins.runtime.opencv"
OURS = machine.OPENCV


@pytest.fixture
def present(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Distributions of OpenCV that seem to be installed, none at first."""
    names: set[str] = set()
    version = importlib.metadata.version

    def seen(name: str) -> str:
        if "opencv" not in name:
            return version(name)
        if name not in names:
            raise importlib.metadata.PackageNotFoundError(name)
        return "5.0"

    monkeypatch.setattr(importlib.metadata, "version", seen)
    return names


def _modules() -> list[str]:
    return [name for name in sys.modules if name == HERE or name.partition(".")[0] == "cv2"]


@pytest.fixture
def imported_again() -> Iterator[Any]:
    """Function that imports our module as if nothing had imported it or OpenCV."""
    before = {name: sys.modules.pop(name) for name in _modules()}
    yield lambda: importlib.import_module(HERE)
    for name in _modules():
        del sys.modules[name]
    sys.modules.update(before)


def test_one_distribution_is_no_collision(present: set[str]) -> None:
    assert machine.opencv_collision() is None
    present.add("opencv-python")
    assert machine.opencv_collision() is None
    assert machine.opencv_remedy() == (f"pip uninstall -y opencv-python && pip install {OURS}")


def test_doctor_says_what_to_do_where_two_collide(
    present: set[str], capsys: pytest.CaptureFixture[str]
) -> None:
    present.update({"opencv-python", OURS})
    assert main(["doctor"]) == 0
    (line,) = (x for x in capsys.readouterr().out.splitlines() if x.startswith("OpenCV: "))
    assert line == (
        f"OpenCV: opencv-python and {OURS} overwrite each other's files; keep one: "
        f"pip uninstall -y opencv-python {OURS} && pip install {OURS}"
    )


def test_what_is_left_of_two_is_noticed(
    present: set[str], imported_again: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    present.add("opencv-python")
    (tmp_path / "cv2").mkdir()  # as `pip uninstall` of one of them may leave it
    (tmp_path / "cv2" / "data.py").touch()
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    importlib.invalidate_caches()
    with pytest.raises(DependencyError, match="in part only .*: pip uninstall -y opencv-python &&"):
        imported_again()


def test_a_missing_library_of_the_system_is_named(
    present: set[str], imported_again: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cv2.py").write_text("raise ImportError('libGL.so.1: cannot open')")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    importlib.invalidate_caches()
    with pytest.raises(DependencyError, match=rf"\(libGL.so.1: cannot open\): pip install {OURS}"):
        imported_again()
