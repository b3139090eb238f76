"""The map of the extremes names only tests that there are, and every test of this folder."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MAP = ROOT / "lab" / "reports" / "extremes.md"
PLACE = re.compile(r"`([\w/]+/test_\w+\.py)(?:::(test_\w+))?`")

pytestmark = pytest.mark.skipif(not MAP.exists(), reason="the documents are not here")


def rows() -> list[list[str]]:
    """Cells of the lines of the map's tables that name tests."""
    lines = MAP.read_text(encoding="utf-8").splitlines()
    table = [line for line in lines if line.startswith("|") and not line.startswith("|---")]
    return [line.strip("|").split("|") for line in table]


def test_every_row_has_a_test() -> None:
    quantities = [row for row in rows() if len(row) == 4 and row[3].strip() != "shown by"]
    assert len(quantities) >= 30
    for row in quantities:
        assert PLACE.search(row[3]), row


def test_every_test_that_is_named_is_there() -> None:
    named = PLACE.findall(MAP.read_text(encoding="utf-8"))
    assert len(named) >= 30
    for file, name in named:
        source = (ROOT / "tests" / file).read_text(encoding="utf-8")
        assert not name or f"def {name}(" in source, (file, name)


def test_every_file_of_this_folder_is_on_the_map() -> None:
    named = {file for file, _ in PLACE.findall(MAP.read_text(encoding="utf-8"))}
    files = {f"extremes/{path.name}" for path in Path(__file__).parent.glob("test_*.py")}
    assert files <= named
