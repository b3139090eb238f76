"""benchmarks/rows.py: what every file of results is read and written with."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

FILE = Path(__file__).parents[2] / "benchmarks" / "rows.py"
pytestmark = pytest.mark.skipif(not FILE.exists(), reason="the benchmarks are not here")


@pytest.fixture(scope="module")
def rows() -> ModuleType:
    spec = importlib.util.spec_from_file_location("rows", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def planned() -> list[dict[str, int]]:
    return [{"run": i} for i in range(7)]


def key(row: dict[str, int]) -> int:
    return row["run"]


@pytest.mark.parametrize("parts", [1, 2, 3, 8])
def test_each_run_belongs_to_one_share(rows: ModuleType, tmp_path: Path, parts: int) -> None:
    out = tmp_path / "results.jsonl"
    shares = [
        [key(row) for row in rows.missing(planned(), out, key, f"{part}/{parts}")]
        for part in range(parts)
    ]
    assert sorted(run for share in shares for run in share) == list(range(7))


@pytest.mark.parametrize("share", ["2/2", "1/0", "-1/2", "2", "a/b"])
def test_a_share_that_is_none_is_refused(rows: ModuleType, tmp_path: Path, share: str) -> None:
    with pytest.raises(SystemExit, match=r"0 to N - 1"):
        next(rows.missing(planned(), tmp_path / "results.jsonl", key, share))


def test_shares_do_not_shift_when_runs_are_done(rows: ModuleType, tmp_path: Path) -> None:
    out = tmp_path / "results.jsonl"
    before = [key(row) for row in rows.missing(planned(), out, key, "1/2")]
    rows.append(out, {"run": 0})  # of the other share
    rows.append(out, {"run": 3})
    assert before == [1, 3, 5]
    assert [key(row) for row in rows.missing(planned(), out, key, "1/2")] == [1, 5]


def test_what_others_did_meanwhile_is_not_done_again(rows: ModuleType, tmp_path: Path) -> None:
    out = tmp_path / "new" / "results.jsonl"
    todo = rows.missing(planned(), out, key)
    assert next(todo) == {"run": 0}
    rows.append(out, {"run": 1})
    assert next(todo) == {"run": 2}


def test_missing_runs_are_measured_added_and_shown(
    rows: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "results.jsonl"
    rows.append(out, {"run": 1})
    rows.run_missing(planned(), lambda run: {**run, "loss": run["run"] / 2}, out, key, "1/2")
    found = {key(row): row.get("loss") for row in rows.read(out)}
    assert found == {1: None, 3: 1.5, 5: 2.5}
    assert len(capsys.readouterr().err.splitlines()) == 2


def test_what_a_run_has_kept_is_removed_when_its_row_is_there(
    rows: ModuleType, tmp_path: Path
) -> None:
    out, there = tmp_path / "results.jsonl", []
    rows.append(out, {"run": 4})  # and it was killed before that was removed
    rows.run_missing(
        planned(),
        dict,
        out,
        key,
        "1/3",
        clear=lambda run: there.append((run["run"], len(rows.read(out)))),
    )
    assert there == [(4, 1), (1, 2)]


def test_a_row_that_does_not_count_is_missing(rows: ModuleType, tmp_path: Path) -> None:
    out = tmp_path / "results.jsonl"
    rows.append(out, {"run": 2, "renders": 500})
    rows.append(out, {"run": 4, "renders": 2000})
    found = rows.missing(planned(), out, key, counts=lambda row: row["renders"] >= 2000)
    assert [key(row) for row in found] == [0, 1, 2, 3, 5, 6]


def test_a_row_says_what_made_it(rows: ModuleType, tmp_path: Path) -> None:
    out = tmp_path / "results.jsonl"
    rows.append(out, {"run": 1})
    (row,) = rows.read(out)
    assert json.loads(out.read_text()) == row
    assert set(row) == {"run", "date", "commit", "packages", "machine", "kernels"}
    assert set(row["kernels"]) == {"blas", "numpy", "torch"}
    assert {"python", "numpy", "torch"} <= set(row["packages"])
    system = row["machine"]["system"]
    assert "-" not in system


def test_a_row_has_no_provenance_of_its_own(rows: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="packages already"):
        rows.append(tmp_path / "results.jsonl", {"run": 1, "packages": {}})
    assert not (tmp_path / "results.jsonl").exists()


def test_a_row_of_another_process_keeps_its_provenance(rows: ModuleType, tmp_path: Path) -> None:
    out = tmp_path / "results.jsonl"
    rows.append(out, {"run": 1}, made_by={"date": "2026-01-01", "commit": None})
    assert rows.read(out) == [{"run": 1, "date": "2026-01-01", "commit": None}]


def test_rows_that_belong_together_are_added_all_or_none(rows: ModuleType, tmp_path: Path) -> None:
    out, made_by = tmp_path / "results.jsonl", {"commit": None}
    with pytest.raises(TypeError):
        rows.append(out, {"run": 1}, {"run": object()}, made_by=made_by)
    assert not out.exists()
    rows.append(out, {"run": 1}, {"run": 2}, made_by=made_by)
    assert rows.read(out) == [{"run": 1, "commit": None}, {"run": 2, "commit": None}]


def test_a_line_that_is_cut_off_is_named(rows: ModuleType, tmp_path: Path) -> None:
    out = tmp_path / "results.jsonl"
    out.write_text('{"run": 1}\n{"run": ')
    with pytest.raises(ValueError, match=r"results\.jsonl:2"):
        rows.read(out)


def test_a_table_of_a_missing_file_is_an_error(rows: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        rows.read(tmp_path / "results.jsonl")
    assert rows.rows_of(tmp_path / "results.jsonl") == []


def test_a_command_runs_its_part_and_shows_the_table(
    rows: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "results.jsonl"

    def call(*words: str) -> str:
        monkeypatch.setattr(sys, "argv", ["program.py", *words])
        rows.command("About.", planned(), dict, out, key, lambda found: f"{len(found)} rows")
        return capsys.readouterr().out

    assert call("--part", "1/2") == ""
    assert [key(row) for row in rows.read(out)] == [1, 3, 5]
    assert call("--table") == "3 rows\n"
