"""Texts of commands: defaults and numbers."""

from __future__ import annotations

import pytest

from fide_plugins.runtime.messages import counted

from .conftest import fide


def test_one_thread_is_one_thread() -> None:
    assert [counted(n, "thread") for n in (0, 1, 2)] == ["0 threads", "1 thread", "2 threads"]


def test_fit_names_the_defaults_of_budget_and_loss(capsys: pytest.CaptureFixture[str]) -> None:
    assert fide("fit", "--help") == 0
    letters = "".join(capsys.readouterr().out.split())  # lines break at hyphens, too
    assert "numberofrenders(2000;with--model5000;with--timeor--untilstalled:any)" in letters
    assert "see:fidelistlosses(mse)" in letters
