"""A warning names the line of the user, whatever lies between."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import FunctionType

import pytest

from fide_plugins.runtime.threads import user_threads
from fide_plugins.runtime.warn import warn_user


def ours(function: Callable[[], None]) -> Callable[[], None]:
    """The function as if a module of the library had defined it."""
    assert isinstance(function, FunctionType)
    names = {**function.__globals__, "__name__": "fide_plugins.learning.somewhere"}
    return FunctionType(function.__code__, names, closure=function.__closure__)


@pytest.mark.parametrize("decorated", [False, True])
def test_the_line_is_that_of_the_call_into_the_library(decorated: bool) -> None:
    def deep() -> None:
        warn_user("look here", UserWarning)

    inner = ours(deep)
    call = user_threads(inner) if decorated else inner
    with pytest.warns(UserWarning, match="look here") as caught:
        call()
    assert Path(caught[0].filename) == Path(__file__)
    lines = Path(__file__).read_text("utf-8").splitlines()
    assert lines[caught[0].lineno - 1].strip() == "call()"
