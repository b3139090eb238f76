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


def test_version() -> None:
    assert fide_plugins.__version__ == importlib.metadata.version("fide-plugins")
