"""Standard streams that are closed, full, or read by nobody."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from fide_plugins.cli import main
from fide_plugins.cli.terminal import standard_streams

FULL = Path("/dev/full")
full = pytest.mark.skipif(not FULL.exists(), reason="no device that is always full")


def fide(code: str, redirected: str) -> subprocess.CompletedProcess[str]:
    """Python code in a process of the shell, with its streams redirected."""
    command = f'exec "$0" -c "$1" {redirected}'
    return subprocess.run(
        ["sh", "-c", command, sys.executable, code], capture_output=True, text=True, timeout=60
    )


@full
@pytest.mark.parametrize("words", ["--version", "fit --help"])
def test_output_on_a_full_disk_is_one_line_and_an_exit_code(words: str) -> None:
    code = f"import sys; from fide_plugins.cli import main; sys.exit(main({words.split()}))"
    done = fide(code, ">/dev/full")
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        "fide: cannot write to standard output: No space left on device"
    ]
    assert fide(code, ">/dev/full 2>&1").returncode == 1


@full
def test_messages_on_a_full_disk_are_lost_and_end_nothing() -> None:
    code = "from fide_plugins.cli.terminal import note; note('no'); note('no'); print('done')"
    done = fide(code, "2>/dev/full")
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\n", "")


def test_no_file_takes_the_place_of_a_closed_stream(tmp_path: Path) -> None:
    """Else messages would be written into it, and what a child of this process prints."""
    code = f"""
import os, subprocess, sys
from fide_plugins.cli.terminal import standard_streams
with standard_streams():
    file = os.open({str(tmp_path / "file")!r}, os.O_CREAT | os.O_WRONLY)
    print("message", file=sys.stderr, flush=True)
    print("result", flush=True)
    subprocess.run(["sh", "-c", "echo message; echo message >&2"], check=True)
    sys.exit(file)
"""
    assert fide(code, "<&- >&- 2>&-").returncode > 2
    assert (tmp_path / "file").read_bytes() == b""


def test_a_fit_without_standard_streams(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Python starts where they are closed."""
    monkeypatch.chdir(tmp_path)
    Path("scene.py").write_text(
        "import numpy as np\ndef render(p):\n    return np.full((4, 4, 3), p['gray'])\n"
    )
    Path("space.toml").write_text('[gray]\ntype = "float"\nlow = 0\nhigh = 1\n')
    from PIL import Image

    Image.new("RGB", (4, 4), (90, 90, 90)).save("t.png")
    for name in ("stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    words = "fit t.png --renderer scene.py:render --space space.toml --budget 9 --workers 0"
    assert main([*words.split(), "--out", "o"]) == 0
    assert Path("o", "run.ckpt").exists()
    assert sys.stdin is sys.stdout is sys.stderr is None


def test_streams_are_given_back() -> None:
    before = sys.stdin, sys.stdout, sys.stderr
    with standard_streams():
        assert sys.stdout is not before[1] and sys.stdout.fileno
    assert (sys.stdin, sys.stdout, sys.stderr) == before
