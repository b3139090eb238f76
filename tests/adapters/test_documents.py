"""The code at the top of the two adapters' pages runs as it stands, and finds the target."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest

DOCS = Path(__file__).parents[2] / "docs" / "reference"


def run(page: str) -> dict[str, Any]:
    """Names that the first block of Python of a page defines."""
    code = re.findall(r"```python\n(.*?)```", (DOCS / page).read_text("utf-8"), re.DOTALL)[0]
    assert len([line for line in code.splitlines() if line.strip()]) <= 12
    names: dict[str, Any] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        exec(compile(code, page, "exec"), names)
    return names


def test_optuna(capsys: pytest.CaptureFixture[str]) -> None:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = run("optuna.md")["study"]
    assert study.best_params == pytest.approx({"x": 0.7, "y": 0.35}, abs=0.01)
    assert str(study.best_params) in capsys.readouterr().out
    counts = study.sampler.counts(study)
    assert counts["member"] + counts["step"] == counts["image"] == 200


def test_nevergrad(capsys: pytest.CaptureFixture[str]) -> None:
    optimizer = run("nevergrad.md")["optimizer"]
    best = optimizer.recommend().value
    np.testing.assert_allclose(best, [0.7, 0.35], atol=0.01)
    assert str(best) in capsys.readouterr().out
    assert optimizer.num_images == 200
