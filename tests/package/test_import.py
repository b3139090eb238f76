"""The package as a whole: it imports quickly, names what it has, and says its version once."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys

import pytest

import fide_plugins

PROBE = """
import sys, time
start = time.process_time()  # other processes share this machine
import fide_plugins
seconds = time.process_time() - start
heavy = {"torch", "numpy", "scipy", "cv2", "matplotlib", "cma", "kornia", "numba"}
print(seconds, *sorted(heavy & set(sys.modules)))
"""


def test_importing_takes_no_time_and_loads_nothing() -> None:
    results = []
    for _ in range(3):  # the best of three
        output = subprocess.run(
            [sys.executable, "-c", PROBE], capture_output=True, text=True, check=True
        )
        seconds, *heavy = output.stdout.split()
        assert heavy == []
        results.append(float(seconds))
    assert min(results) < 0.2


def test_submodules_are_loaded_on_demand() -> None:
    public = {*fide_plugins.__all__, "FIDESampler"}  # which needs Optuna
    assert set(dir(fide_plugins)) == public and "import_module" not in public
    assert all(hasattr(fide_plugins, name) for name in public)
    assert fide_plugins.checkpoint.VERSION >= 1
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = fide_plugins.nothing  # type: ignore[attr-defined]


def test_the_error_of_missing_weights_is_found_where_weights_are_read() -> None:
    error = fide_plugins.errors.WeightsNotFoundError
    for where in (fide_plugins, fide_plugins.encoders, fide_plugins.losses):
        assert where.WeightsNotFoundError is error
        assert "WeightsNotFoundError" in where.__all__


SUBMODULES_FIRST = """
import importlib, pkgutil, types
import fide_plugins.learning
for module in pkgutil.iter_modules(fide_plugins.learning.__path__, "fide_plugins.learning."):
    importlib.import_module(module.name)
from fide_plugins.learning import LearnProgress, Model, Report, learn
import fide_plugins
assert isinstance(learn, types.FunctionType) and fide_plugins.learn is learn
"""


@pytest.mark.thorough
def test_no_submodule_hides_what_its_package_exports() -> None:
    subprocess.run([sys.executable, "-c", SUBMODULES_FIRST], check=True)


def test_version() -> None:
    assert fide_plugins.__version__ == importlib.metadata.version("fide-plugins")
