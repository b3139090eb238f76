"""The terminal: streams that are closed or full, progress."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from fide_lab.run import Progress
from fide_plugins.cli import main, progress

FULL = Path("/dev/full")
full = pytest.mark.skipif(not FULL.exists(), reason="no device that is always full")


def in_shell(code: str, redirected: str) -> subprocess.CompletedProcess[str]:
    """Python code in a process of the shell, with its streams redirected."""
    command = f'exec "$0" -c "$1" {redirected}'
    return subprocess.run(
        ["sh", "-c", command, sys.executable, code], capture_output=True, text=True, timeout=60
    )


@full
@pytest.mark.parametrize("words", ["--version", "fit --help"])
def test_output_on_a_full_disk_is_one_line_and_an_exit_code(words: str) -> None:
    code = f"import sys; from fide_plugins.cli import main; sys.exit(main({words.split()}))"
    done = in_shell(code, ">/dev/full")
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        "fide: cannot write to standard output: No space left on device"
    ]
    assert in_shell(code, ">/dev/full 2>&1").returncode == 1


@full
def test_messages_on_a_full_disk_are_lost_and_end_nothing() -> None:
    code = "from fide_plugins.cli.terminal import note; note('no'); note('no'); print('done')"
    done = in_shell(code, "2>/dev/full")
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\n", "")


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
    assert sys.stdout is sys.stderr is None


# -- the line that says how far a run is -----------------------------------------------------------


NO_TIME = dict.fromkeys(("render", "encode", "train", "search"), 0.0)


def test_a_log_gets_a_line_soon_and_then_one_a_minute(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0
    monkeypatch.setattr("fide_plugins.cli.progress.time.monotonic", lambda: now)
    report = progress.lines("x")
    told = []
    for second in range(0, 601):
        now = 1000.0 + second
        report(Progress(second, 10_000, 0.5, float(second), NO_TIME))
        if capsys.readouterr().err:
            told.append(second)
    assert told == [5, *range(65, 601, 60)]
    report(Progress(10_000, 10_000, 0.5, 601.0, NO_TIME))
    assert "10000/10000" in capsys.readouterr().err  # the end is always told
