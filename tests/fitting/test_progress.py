"""What a fit says while it goes on: a function gets all of it, the last state too."""

from __future__ import annotations

from pathlib import Path

import pytest

from fide_lab.run import Progress
from fide_plugins import fit
from fide_plugins.errors import OptionError

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
