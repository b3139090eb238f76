"""What a fit says while it goes on: a function gets all of it, the last state too."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from fide_lab.run import Progress
from fide_plugins import fit
from fide_plugins.errors import OptionError
from fide_plugins.fitting.callbacks import reporting

from .scene import SPACE, disk, target


def test_a_function_gets_the_last_state_of_a_fit_that_is_over_at_once() -> None:
    """Reports are far apart; the last one is not left out for that."""
    seen: list[Progress] = []
    result = fit(disk(), target(), SPACE, 40, workers=0, seed=0, progress=seen.append)
    assert seen[-1].evaluations == seen[-1].budget == 40
    assert result.best is not None and seen[-1].best_loss == result.best.loss
    assert 0 < seen[-1].wall_s <= result.seconds
    assert seen[-1].remark == "0 rendering"


def test_a_function_hears_of_failures() -> None:
    seen: list[Progress] = []
    with pytest.warns(RuntimeWarning, match="too far to the right"):
        result = fit(disk("raises"), target(), SPACE, 60, workers=0, seed=0, progress=seen.append)
    assert result.failures > 0
    assert seen[-1].remark == f"0 rendering, {result.failures} failed"


@pytest.mark.parametrize("progress", ["yes", 1, []])
def test_what_is_no_progress_is_refused_before_anything_is_written(
    progress: object, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match="progress must be True, False, None or a function"):
        fit(disk(), target(), SPACE, 4, workers=0, out=tmp_path / "run", progress=progress)
    assert not (tmp_path / "run").exists()


def test_a_line_has_no_loss_before_there_is_one(capsys: pytest.CaptureFixture[str]) -> None:
    with reporting(True) as report:
        assert report is not None
        report(Progress(100, 1000, math.inf, 1.0, {}, remark="1 rendering"))
        report(Progress(300, 1000, 0.0125, 2.0, {}, remark="3 rendering, 1 failed"))
    first, second = capsys.readouterr().err.split("\r")[1:3]
    assert "100/1000" in first and "1 rendering" in first and "inf" not in first
    assert "300/1000" in second and "best 0.0125  3 rendering, 1 failed" in second
