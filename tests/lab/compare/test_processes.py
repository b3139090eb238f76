"""Several processes: one that dies takes one item with it, and none outlives the others."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fide_lab.compare.driver import in_processes

HERE = str(Path(__file__).parent)


@pytest.fixture
def child(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module `child_work`, which other processes find as this one does: by sys.path."""
    monkeypatch.syspath_prepend(HERE)
    return importlib.import_module("child_work")


def test_every_item_has_its_result_and_a_death_takes_one_with_it(child: Any) -> None:
    items = [1, "die", 2, 3, 4, 5]
    results = list(in_processes(child.work, items, 2, child.lost))
    assert sorted((str(item) for _, item in results)) == sorted(map(str, items))
    assert [item for pid, item in results if pid is None] == ["die"]
    pids = {pid for pid, _ in results} - {None}
    assert os.getpid() not in pids and 1 <= len(pids) <= 3


def test_leaving_early_ends_the_processes(
    child: Any, tmp_path: Path, ends: Callable[[int], bool]
) -> None:
    started = time.monotonic()
    results = in_processes(child.work, [1, tmp_path / "a"], 2, child.lost)
    assert next(results)[1] == 1
    pid = _written(tmp_path / "a")
    results.close()  # type: ignore[attr-defined]
    assert ends(pid) and time.monotonic() - started < child.LONG / 2


SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, {folder!r})
if __name__ == "__main__":
    from fide_lab.compare.driver import in_processes
    from child_work import lost, work
    list(in_processes(work, [Path({out!r})], 2, lost))
"""


def test_processes_follow_their_parent(tmp_path: Path, ends: Callable[[int], bool]) -> None:
    script = tmp_path / "script.py"
    out = tmp_path / "a"
    script.write_text(SCRIPT.format(folder=HERE, out=str(out)))
    parent = subprocess.Popen([sys.executable, str(script)])
    try:
        pid = _written(out)
    finally:
        parent.kill()
        parent.wait()
    assert ends(pid)


def _written(path: Path) -> int:
    for _ in range(3000):
        if path.exists() and path.read_text():
            return int(path.read_text())
        time.sleep(0.01)
    raise AssertionError("the process never began")
