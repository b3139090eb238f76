"""What the README shows works as it is written there."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import nevergrad
import numpy as np
import optuna
import pytest

from fide_adapters.image_loss import ImageLoss

README = Path(__file__).parents[2] / "README.md"


def code_blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", README.read_text("utf-8"), re.DOTALL)


def test_the_readme_s_own_python_finds_the_disk(capsys: pytest.CaptureFixture[str]) -> None:
    code = code_blocks()[0]
    names: dict[str, object] = {}
    exec(compile(code, str(README), "exec"), names)
    *_, loss = capsys.readouterr().out.replace("]", " ").split()
    assert float(loss) < 1e-3
    assert len([line for line in code.splitlines() if line.strip()]) <= 15


def test_the_readme_s_lines_for_optuna_and_nevergrad_work() -> None:
    _, *codes = code_blocks()
    names: dict[str, Any] = {"optuna": optuna, "ng": nevergrad, "target": np.zeros((8, 8, 3))}
    names["parametrization"] = nevergrad.p.Array(shape=(2,), lower=0, upper=1)
    for code in codes:
        exec(compile(code, str(README), "exec"), names)
    sampler, study, optimizer = (names[name] for name in ("sampler", "study", "optimizer"))

    def render(x: Any) -> Any:
        return np.full((8, 8, 3), np.mean(x))

    def objective(trial: optuna.Trial) -> float:
        return float(sampler.tell_image(trial, render([trial.suggest_float("x", 0, 1)])))

    study.optimize(objective, n_trials=20)
    assert sampler.counts(study)["image"] == 20 and study.best_value < 0.1
    optimizer.budget = 20
    with ThreadPoolExecutor(4) as executor:
        best = optimizer.minimize(
            lambda x: ImageLoss(float(np.mean(x) ** 2), render(x)), executor=executor
        )
    assert optimizer._engine._pictures == 20 and best.loss < 0.1
