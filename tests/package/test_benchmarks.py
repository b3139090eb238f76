"""Programs of `benchmarks/`: each is listed with its page, and what reads and writes their rows."""

from __future__ import annotations

import importlib.util
import re
from collections import Counter
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
BENCHMARKS = ROOT / "benchmarks"
pytestmark = pytest.mark.skipif(not BENCHMARKS.exists(), reason="the benchmarks are not here")


def test_every_program_is_listed_once_and_its_page_names_it() -> None:
    listed: Counter[str] = Counter()
    for line in (BENCHMARKS / "README.md").read_text("utf-8").splitlines():
        if line.startswith("| `"):
            first, *_, last = line.strip("| ").split("|")
            programs = re.findall(r"`(\w+\.py)`", first)
            listed.update(programs)
            if pages := re.findall(r"\]\(([^)#]+)", last):
                text = "".join((BENCHMARKS / page).read_text("utf-8") for page in pages)
                assert f"benchmarks/{programs[0]}" in text, programs
    assert listed == Counter(path.name for path in BENCHMARKS.glob("*.py"))


def test_every_file_of_results_is_read_by_a_program() -> None:
    text = "".join(path.read_text("utf-8") for path in BENCHMARKS.glob("*.py"))
    names = {path.name for path in (BENCHMARKS / "results").iterdir()}
    assert {n for n in names if n not in text} <= {
        f"suite_{i}.jsonl" for i in ("v1", "v2", "v3", "foreign_v1")
    }


@pytest.fixture(scope="module")
def rows() -> ModuleType:
    spec = importlib.util.spec_from_file_location("rows", BENCHMARKS / "rows.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


PLANNED = [{"run": i} for i in range(7)]


def key(row: dict[str, int]) -> int:
    return row["run"]


def test_only_missing_runs_of_a_share_are_measured(rows: ModuleType, tmp_path: Path) -> None:
    out = tmp_path / "results.jsonl"
    rows.append(out, {"run": 0}, {"run": 1}, {"run": 4, "short": True})

    def measure(run: dict[str, Any]) -> dict[str, Any]:
        if run == {"run": 3}:
            rows.append(out, {"run": 5})  # another process does it meanwhile
        return {**run, "loss": run["run"] / 2}

    cleared: list[int] = []
    rows.run_missing(PLANNED, measure, out, key, "1/2", clear=lambda run: cleared.append(key(run)))
    assert [key(row) for row in rows.read(out) if "loss" in row] == [3]
    assert cleared == [0, 1, 4, 3]
    long = rows.missing(PLANNED, out, key, counts=lambda row: "short" not in row)
    assert [key(row) for row in long] == [2, 4, 6]


def test_a_row_says_what_made_it_and_the_file_says_it_once(
    rows: ModuleType, tmp_path: Path
) -> None:
    out, made_by = tmp_path / "results.jsonl", {"date": "2026-01-01", "commit": None}
    rows.append(out, {"run": 1}, {"run": 2})
    rows.append(out, {"run": 3})
    rows.append(out, {"run": 4}, made_by=made_by)  # of another process
    assert len(out.read_text().splitlines()) == 6
    first, second, third, other = rows.read(out)
    assert set(first) == {"run", "date", "commit", "packages", "machine", "kernels"}
    assert set(first["kernels"]) == {"blas", "numpy", "torch"}
    assert {"python", "numpy", "torch"} <= set(first["packages"])
    assert {**first, "run": 3} == {**second, "run": 3} == third
    assert other == {"run": 4, **made_by}


def test_rows_are_added_all_or_none(rows: ModuleType, tmp_path: Path) -> None:
    out = tmp_path / "results.jsonl"
    with pytest.raises(ValueError, match="packages already"):
        rows.append(out, {"run": 1, "packages": {}})
    with pytest.raises(TypeError):
        rows.append(out, {"run": 1}, {"run": object()}, made_by={"commit": None})
    assert not out.exists() and rows.rows_of(out) == []
