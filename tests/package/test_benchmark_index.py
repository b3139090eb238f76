"""benchmarks/README.md lists every program; every file of results belongs to one or to a page."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BENCHMARKS = ROOT / "benchmarks"
pytestmark = pytest.mark.skipif(not BENCHMARKS.exists(), reason="the benchmarks are not here")


def rows() -> list[tuple[list[str], str]]:
    """Programs of each line of the table, and the address of its page ("" without)."""
    found = []
    for line in (BENCHMARKS / "README.md").read_text("utf-8").splitlines():
        if line.startswith("| `"):
            first, *_, last = line.strip("| ").split("|")
            page = re.search(r"\]\(([^)#]+)", last)
            found.append((re.findall(r"`(\w+\.py)`", first), page[1] if page else ""))
    return found


def test_every_program_is_listed_once() -> None:
    listed = Counter(program for programs, _ in rows() for program in programs)
    assert listed == Counter(path.name for path in BENCHMARKS.glob("*.py"))


WITHOUT_A_COMMAND = {"forward_scenes.py", "encoder_tables.py", "clean_scenes.py"}  # parts of others


def test_the_page_of_a_program_has_its_command() -> None:
    with_page = [(programs, page) for programs, page in rows() if page]
    assert with_page
    for programs, page in with_page:
        text = (BENCHMARKS / page).read_text("utf-8")
        shown = {program for program in programs if f"benchmarks/{program}" in text}
        assert set(programs) - shown <= WITHOUT_A_COMMAND, page


def test_every_file_of_results_is_used() -> None:
    pages = [path for folder in ("docs", "lab") for path in (ROOT / folder).rglob("*.md")]
    sources = [*BENCHMARKS.glob("*.py"), *pages]
    text = "\n".join(path.read_text("utf-8") for path in sources)
    files = [path.name for path in (BENCHMARKS / "results").glob("*.*") if path.is_file()]
    assert files
    assert [name for name in files if not re.search(rf"(?<!\w){re.escape(name)}", text)] == []
