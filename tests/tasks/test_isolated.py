"""What is tried in a process of its own, and what that process does not run."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from fide_tasks import isolated, mitsuba_variant


def test_what_goes_wrong_is_told_in_one_line() -> None:
    assert isolated.failure("", seconds=60) is None
    assert isolated.failure("print(1 / 0)", seconds=60) == "ZeroDivisionError: division by zero"
    assert isolated.failure("import sys; sys.exit(sys.argv[1])", "nothing", seconds=60) == "nothing"
    assert isolated.failure("import os; os._exit(3)", seconds=60) == "exit code 3"


def test_no_code_of_the_folder_is_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "numpy.py").write_text("raise SystemExit('code of the folder')")
    monkeypatch.chdir(tmp_path)
    assert isolated.failure("import numpy", seconds=60) is None


@pytest.mark.skipif(importlib.util.find_spec("mitsuba") is None, reason="Mitsuba is not installed")
def test_no_plugin_of_the_folder_is_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "plugins").mkdir()
    for suffix in ("so", "dylib", "dll"):
        (tmp_path / "plugins" / f"path.{suffix}").write_text("no library")
    monkeypatch.chdir(tmp_path)
    assert mitsuba_variant._check_variant("scalar_rgb", None) is None
