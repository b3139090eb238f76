"""Texts of commands: defaults and numbers."""

from __future__ import annotations

import pytest

from fide_plugins.cli.doctor_command import _counted

from .conftest import fide


def test_one_thread_is_one_thread() -> None:
    assert [_counted(n, "thread") for n in (0, 1, 2)] == ["0 threads", "1 thread", "2 threads"]


def test_fit_names_the_defaults_of_budget_and_loss(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    with pytest.raises(SystemExit):
        fide("fit", "--help")
    words = " ".join(capsys.readouterr().out.split())
    budget = "(2000; with --model 5000; with --time or --until-stalled: any)"
    assert f"number of renders {budget}" in words
    assert "see: fide list losses (mse)" in words
