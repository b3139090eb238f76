"""The folders for OptunaHub: their headers, and that `optunahub` loads and runs them (point 25)."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from types import ModuleType
from typing import Any

import frontmatter
import numpy as np
import optuna
import pytest

import fide_adapters
from fide_adapters.optuna import FIDESampler, image_objective
from fide_lab import suite

REGISTRY = Path(fide_adapters.__file__).parents[1] / "optunahub_registry/package"
FIDE, PROBLEMS = "samplers/fide", "benchmarks/image_fitting"
pytestmark = pytest.mark.skipif(not REGISTRY.exists(), reason="an installed copy has no registry")
hub: Any = pytest.importorskip("optunahub")


def load(package: str) -> ModuleType:
    module: ModuleType = hub.load_local_module(package, registry_root=str(REGISTRY))
    return module


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """`optunahub.load_module` loads what is here, not what is published."""
    monkeypatch.setattr(hub, "load_module", lambda package: load(package))


def header_and_text(package: str) -> tuple[dict[str, Any], str]:
    """As the registry's own check reads them, `header_confirm.py`."""
    post = frontmatter.load(str(REGISTRY / package / "README.md"))
    return post.metadata, post.content


@pytest.mark.parametrize("package", [FIDE, PROBLEMS])
def test_point_25_the_header_is_what_the_registry_confirms(package: str) -> None:
    header, _ = header_and_text(package)
    required = {"author", "title", "description", "tags", "optuna_versions", "license"}
    assert header.keys() == required
    for key in required:
        assert header[key] not in ("", None, []), key
    kind = {FIDE: "sampler", PROBLEMS: "benchmark"}[package]
    assert kind in header["tags"] and all(isinstance(tag, str) for tag in header["tags"])
    assert all(re.fullmatch(r"\d+\.\d+\.\d+", v) for v in header["optuna_versions"])
    assert optuna.__version__ in header["optuna_versions"]
    assert header["license"] == "MIT License"


def test_point_25_the_package_is_the_published_sampler() -> None:
    module: Any = load(FIDE)
    assert module.FIDESampler is FIDESampler
    assert module.__all__ == ["FIDESampler", "image_objective"]
    assert (REGISTRY / FIDE / "requirements.txt").read_text() == "fide-plugins[optuna]\n"


def test_the_benchmark_is_the_fixed_suite() -> None:
    problem = load(PROBLEMS).Problem("sprites", number=1)
    assert isinstance(problem, hub.benchmarks.BaseProblem)
    assert problem.scenes == tuple(suite.read("image-fitting-v1").scenes)
    assert problem.budgets == (500, 2000, 10000) and problem.solved == 1e-3
    params = {name: 0.5 for name in problem.search_space}
    expected = np.mean((problem.render(params) - problem.target) ** 2)
    assert problem.evaluate(params) == pytest.approx(expected, rel=1e-5)
    with pytest.raises(ValueError, match="sprites-10"):
        load(PROBLEMS).Problem("sprites", number=10)


def test_samplers_of_numbers_and_of_images_enter_the_benchmark() -> None:
    problem = load(PROBLEMS).Problem("arm")
    plain = optuna.create_study(directions=problem.directions)
    plain.optimize(problem, n_trials=3)
    assert plain.best_value > problem.solved
    study = optuna.create_study(sampler=FIDESampler(target=problem.target, seed=0))

    def draw(trial: optuna.Trial) -> Any:
        space = problem.search_space.items()
        return problem.render({name: trial.suggest_float(name, d.low, d.high) for name, d in space})

    study.optimize(image_objective(draw), n_trials=3)
    assert study.best_value == pytest.approx(problem.evaluate(study.best_params), rel=1e-5)


@pytest.mark.parametrize(("package", "most"), [(FIDE, 2e-4), (PROBLEMS, 1)])
def test_point_25_the_example_runs(
    package: str, most: float, no_network: None, capsys: pytest.CaptureFixture[str]
) -> None:
    runpy.run_path(str(REGISTRY / package / "example.py"), run_name="__main__")
    assert float(capsys.readouterr().out.split()[0]) < most


@pytest.mark.parametrize(("package", "said"), [(FIDE, "'x'"), (PROBLEMS, "0.001")])
def test_point_25_the_readme_s_python_runs(
    package: str, said: str, no_network: None, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", header_and_text(package)[1], re.DOTALL)
    exec(compile(re.sub(r"n_trials=\d+", "n_trials=20", code), "README.md", "exec"), {})
    assert said in capsys.readouterr().out
