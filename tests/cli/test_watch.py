"""`fide watch`: the address, the page, and the end by Ctrl-C."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import urllib.request
from functools import partial
from pathlib import Path

import pytest

from fide_plugins.cli import main


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_it_serves_until_it_is_stopped(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "fide_plugins", "watch", str(tmp_path), "--no-browser"]
    heard = partial(
        signal.signal, signal.SIGINT, signal.default_int_handler
    )  # background jobs ignore it
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=heard) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        url = line.split()[0]
        assert url.startswith("http://127.0.0.1:") and str(tmp_path) in line
        with urllib.request.urlopen(url + "state.json", timeout=20) as answer:
            assert json.load(answer)["state"] == "not begun"
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 130


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "there is no directory nowhere"),
        ([".", "--port", "70000"], "cannot serve on port 70000.*0 to 65535"),
    ],
)
def test_wrong_usage(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    import re

    assert main(["watch", *words, "--no-browser"]) == 2
    assert re.search(message, capsys.readouterr().err)


def test_of_a_comparison_it_names_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["compare", "voronoi", "--optimizers", "random", "--seeds", "1", "--budget", "10"]
    assert main([*words, "--size", "8", "--task-set", "cells=2", "--out", "both"]) == 0
    capsys.readouterr()
    assert main(["watch", "both", "--no-browser"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    run = str(Path("both/cells/voronoi/mse/random/seed-0"))
    assert f"such as {run};" in line and "fide report both" in line and "cannot serve" not in line
