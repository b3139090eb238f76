"""Folders of tests that the Makefile names are there: pytest would run none of them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.skipif(not (ROOT / "Makefile").exists(), reason="needs the repository")
def test_named_folders_hold_tests() -> None:
    text = (ROOT / "Makefile").read_text("utf-8").replace("\\\n", "")
    named = [
        name for names in re.findall(r"addprefix tests/,([^)]*)", text) for name in names.split()
    ]
    assert len(named) > 20
    missing = [
        name for name in named if not any((ROOT / "tests").glob(f"{name.removesuffix('.py')}*"))
    ]
    empty = [name for name in named if not any((ROOT / "tests" / name).rglob("test_*.py"))]
    assert not missing
    assert all(name.endswith(".py") for name in empty), empty
