"""Names that modules had before `fide_lab` was a package, and `fide_plugins` without it."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import fide_plugins
from fide_plugins.errors import DependencyError
from fide_plugins.runtime import laboratory
from fide_plugins.runtime.registry import Registry

WITHOUT = """
import importlib.util, sys
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, *more: None if name == "fide_lab" else find(name, *more)
from fide_plugins.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize(
    ("old", "new", "attribute"),
    [
        ("fide_plugins.baselines", "fide_lab.baselines", "CMA"),
        ("fide_plugins.experiments.solutions", "fide_lab.solutions", "Found"),
        ("fide_plugins.watch", "fide_lab.watch", "serve"),
        ("fide_plugins.optimizers", "fide_lab.optimizers", "make"),
    ],
)
def test_old_modules_have_what_the_new_ones_have(old: str, new: str, attribute: str) -> None:
    found, expected = importlib.import_module(old), importlib.import_module(new)
    assert getattr(found, attribute) is getattr(expected, attribute)
    with pytest.raises(AttributeError, match="nothing"):
        _ = found.nothing
    with pytest.raises(ImportError):
        importlib.import_module(f"{old}.nothing")


@pytest.mark.parametrize("name", ["baselines", "compare", "harness", "optimizers", "report"])
def test_old_names_of_the_package(name: str) -> None:
    new = importlib.import_module(f"fide_lab.{'run' if name == 'harness' else name}")
    found = getattr(fide_plugins, name)
    assert all(getattr(found, one) is getattr(new, one) for one in new.__all__)


def without_the_laboratory(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", WITHOUT, *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_pretrained_networks_without_the_laboratory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(laboratory, "find_spec", lambda _: None)
    registry: Registry[object] = Registry("loss")
    registry.register("lpips", "fide_lab.pretrained.lpips:LPIPSLoss")
    assert registry.names() == ["lpips"]
    with pytest.raises(DependencyError, match="fide_lab .*PYTHONPATH"):
        registry.make("lpips")


def test_the_command_line_without_the_laboratory(tmp_path: Path) -> None:
    shown = without_the_laboratory("--help")
    assert shown.returncode == 0
    assert "fide fit " in shown.stdout and "fide run" not in shown.stdout
    for words in (["run", "voronoi"], ["fit", "a.png", "--model", "voronoi"]):
        refused = without_the_laboratory(*words)
        assert refused.returncode == 2
        assert "fide_lab (" in refused.stderr and "PYTHONPATH" in refused.stderr
