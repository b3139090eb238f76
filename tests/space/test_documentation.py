"""What docs/reference/space.md shows works as it is written there."""

from __future__ import annotations

import doctest
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "space.md"


def test_the_examples_of_the_page() -> None:
    failures, examples = doctest.testfile(str(PAGE), module_relative=False)
    assert failures == 0 and examples >= 10
