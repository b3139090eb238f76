"""What docs/reference/fit.md shows works as it is written there."""

from __future__ import annotations

import doctest
from pathlib import Path

import numpy as np
import pytest

from fide_plugins.errors import OptionError
from fide_plugins.validation.options import seconds_of

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "fit.md"


def test_the_example_of_the_page(empty_folder: Path) -> None:
    failures, examples = doctest.testfile(str(PAGE), module_relative=False)
    assert failures == 0 and examples >= 7


def test_durations() -> None:
    expected = {"90s": 90, "1d": 86400, "1.5h": 5400, " 2M30S ": 150, "45": 45, 0.5: 0.5}
    assert {text: seconds_of("time", text) for text in expected} == expected
    assert seconds_of("time", np.int64(3)) == 3 and seconds_of("time", np.float32(0.5)) == 0.5
    wrongs = ("", "h", "10 minutes", "5m1h", "-3", 0, -1, True, None, float("nan"), "inf", 10**400)
    for wrong in wrongs:
        with pytest.raises(OptionError, match="time must be a positive number of seconds"):
            seconds_of("time", wrong)
