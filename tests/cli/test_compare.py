"""`fide compare` and `fide report` as a user meets them."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from fide_lab import compare
from fide_plugins.cli import main

from .conftest import fide

SMALL = ["--optimizers", "cma,random", "--seeds", "2", "--budget", "40", "--size", "16"]
SMALL += ["--task-set", "cells=2"]
pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.mark.thorough
def test_compare_runs_everything_and_makes_the_report(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["compare", "voronoi", *SMALL, "--losses", "loi", "--out", "out"]
    assert fide(*words, "--threshold", "loi=0.5") == 0
    captured = capsys.readouterr()
    line = re.compile(r"^\[\d/4\] voronoi (loi \w+ seed \d): [\d.e-]+ after 40 renders", re.M)
    assert len(set(line.findall(captured.err))) == 4
    assert "| optimizer" in captured.out and captured.out.endswith("look at out/report.html\n")
    assert "Success is loi of 0.5 or less." in captured.out
    names = {"report.html", "results.csv", "cells", "targets"}
    assert names <= set(os.listdir("out"))
    (call,) = compare.read("out").calls
    assert call["command"] == ["fide", *words, "--threshold", "loi=0.5"]
    assert compare.read("out").settings["metrics"] == ["loi", "mse", "perceptual"]

    assert fide(*words) == 2
    assert "already holds a comparison with these settings" in capsys.readouterr().err
    assert fide(*words, "--resume") == 0
    assert "4 of 4 runs are finished" in capsys.readouterr().err
    assert fide(*[word if word != "40" else "50" for word in words], "--resume") == 2
    assert "other settings: budget is 40 there and 50 here" in capsys.readouterr().err

    table = Path("out/cells/voronoi/loi/cma/seed-1/improvements.csv")
    table.write_bytes(table.read_bytes()[:-1])
    assert fide("report", "out", "-o", "pages/p.html") == 0
    assert "voronoi loi cma seed 1 is damaged and left out" in capsys.readouterr().err
    assert Path("pages/p.html").is_file() and Path("pages/p-results.csv").is_file()
    assert fide(*words, "--resume") == 0
    err = capsys.readouterr().err
    assert "voronoi loi cma seed 1 is damaged and will be repeated" in err
    assert err.count("[") == 1 and "it was damaged" in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["compare", "vornoi", *SMALL], "no task is named 'vornoi'; the tasks: .*voronoi"),
        (["compare", "voronoi", *SMALL, "--optimizers", "a,,b"], "names separated by commas"),
        (
            ["compare", "voronoi", *SMALL, "--threshold", "mze=1"],
            "a threshold is given for 'mze', which is not compared; choose from mse, voronoi/mse",
        ),
        (["compare", "voronoi", *SMALL, "--jobs", "1000"], "at most one process per core"),
        (["report", "nothing"], "nothing holds no comparison; make one"),
    ],
)
def test_wrong_usage(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", "out"] if words[0] == "compare" else []
    assert main([*words, *out]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert re.search(message, captured.err), captured.err
    assert not Path("out").exists()
