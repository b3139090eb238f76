"""The folder for OptunaHub: its header, its layout, and that it runs (acceptance point 25)."""

from __future__ import annotations

import importlib.util
import re
import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import frontmatter
import optuna
import pytest

import fide_adapters
from fide_adapters.optuna import FIDESampler

FOLDER = Path(fide_adapters.__file__).parents[1] / "optunahub_registry/package/samplers/fide"
pytestmark = pytest.mark.skipif(not FOLDER.exists(), reason="an installed copy has no such folder")


def load() -> ModuleType:
    """Load the package as `optunahub.load_local_module` does."""
    name = "optunahub_registry.package.samplers.fide"
    spec = importlib.util.spec_from_file_location(name, FOLDER / "__init__.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> None:
    """An `optunahub` that has this package and no network."""
    module: Any = ModuleType("optunahub")
    module.load_module = lambda package: {"samplers/fide": load()}[package]
    monkeypatch.setitem(sys.modules, "optunahub", module)


def header_and_text() -> tuple[dict[str, Any], str]:
    """As the registry's own check reads them, `header_confirm.py`."""
    post = frontmatter.load(str(FOLDER / "README.md"))
    return post.metadata, post.content


def test_point_25_the_header_is_what_the_registry_confirms() -> None:
    header, _ = header_and_text()
    required = {"author", "title", "description", "tags", "optuna_versions", "license"}
    assert header.keys() == required
    for key in required:
        assert header[key] not in ("", None, []), key
    assert "sampler" in header["tags"] and all(isinstance(tag, str) for tag in header["tags"])
    assert all(re.fullmatch(r"\d+\.\d+\.\d+", v) for v in header["optuna_versions"])
    assert optuna.__version__ in header["optuna_versions"]
    assert header["license"] == "MIT License"


def test_point_25_the_package_is_the_published_sampler() -> None:
    module: Any = load()
    assert module.FIDESampler is FIDESampler
    assert module.__all__ == ["FIDESampler", "image_objective"]
    assert (FOLDER / "requirements.txt").read_text() == "fide-plugins[optuna]\n"


def test_point_25_the_example_finds_the_disk(hub: None, capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(FOLDER / "example.py"), run_name="__main__")
    assert float(capsys.readouterr().out.split()[0]) < 2e-4


def test_point_25_the_readme_s_python_runs(hub: None, capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", header_and_text()[1], re.DOTALL)
    exec(compile(code.replace("n_trials=400", "n_trials=20"), "README.md", "exec"), {})
    assert "'x'" in capsys.readouterr().out
