"""How many cores a process may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fide_plugins.runtime.machine import cores


@pytest.fixture(autouse=True)
def _sixteen(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that may run on 16 cores."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)), raising=False)


def groups(folder: Path, lines: str, files: dict[str, str]) -> int:
    """Cores of a process in these control groups."""
    (folder / "groups").write_text(lines)
    for name, text in files.items():
        file = folder / "mounted" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return cores(folder / "groups", folder / "mounted")


@pytest.mark.parametrize(
    ("lines", "files", "expected"),
    [
        ("0::/\n", {}, 16),
        ("0::/a/b\n", {"a/b/cpu.max": "max 100000\n"}, 16),
        ("0::/a/b\n", {"a/b/cpu.max": "250000 100000\n"}, 3),
        ("0::/a/b\n", {"a/b/cpu.max": "max 100000\n", "a/cpu.max": "200000 100000\n"}, 2),
        ("0::/outside/name\n", {"cpu.max": "50000 100000\n"}, 1),  # a container
        (
            "4:cpu,cpuacct:/a\n3:cpuset:/b\n0::/\n",
            {"cpu/a/cpu.cfs_quota_us": "400000\n", "cpu/a/cpu.cfs_period_us": "100000\n"},
            4,
        ),
        (
            "4:cpu,cpuacct:/a\n",
            {"cpu/a/cpu.cfs_quota_us": "-1\n", "cpu/a/cpu.cfs_period_us": "100000\n"},
            16,
        ),
        ("0::/\n", {"cpu.max": "3200000 100000\n"}, 16),  # more than there are
        ("0::/\n", {"cpu.max": "odd\n"}, 16),
    ],
)
def test_a_quota_of_a_control_group_counts(
    tmp_path: Path, lines: str, files: dict[str, str], expected: int
) -> None:
    assert groups(tmp_path, lines, files) == expected


def test_without_control_groups_the_affinity_counts(tmp_path: Path) -> None:
    assert cores(tmp_path / "none", tmp_path) == 16
