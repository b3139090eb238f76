"""What docs/reference/compare.md shows in Python works as a script."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from fide_plugins.runtime import machine

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "compare.md"
SMALL = 'seeds=1, budget=60, size=16, task_options={"cells": 2}'


@pytest.mark.thorough
@pytest.mark.skipif(machine.cores() < 2, reason="two processes need two cores")
def test_the_example_is_a_script_of_two_processes(tmp_path: Path) -> None:
    """Each process imports the script again, so what it runs must be under the guard."""
    section = PAGE.read_text("utf-8").partition("\n## From Python\n")[2]
    found = re.search(r"```python\n(.*?)```", section, re.DOTALL)
    assert found is not None
    script = found[1].replace("seeds=6, budget=2000", SMALL)
    assert SMALL in script and "jobs=2" in script
    (tmp_path / "script.py").write_text(script)
    ran = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    runs = list((tmp_path / "runs" / "mine" / "cells").rglob("run.json"))
    assert len(runs) == 2 and (tmp_path / "runs" / "mine" / "report.html").is_file()
