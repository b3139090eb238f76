"""The gallery shows what its examples do: their programs, their pictures, their true values."""

from __future__ import annotations

import re
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from fide_plugins import Choice, Int

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
GALLERY = (ROOT / "docs" / "gallery.md").read_text("utf-8")
SECTIONS = re.split(r"^## ", GALLERY, flags=re.MULTILINE)[1:]
PROGRAMS = sorted(set(re.findall(r"python examples/(\w+)\.py \d+", GALLERY)))


def load(name: str) -> ModuleType:
    spec = spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def section(name: str) -> str:
    (found,) = [one for one in SECTIONS if f"python examples/{name}.py" in one]
    return found


@pytest.mark.parametrize("name", PROGRAMS)
def test_true_values_are_those_of_the_example(name: str) -> None:
    numbers = {float(n) for n in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?", section(name))}
    for parameter, true in load(name).TRUTH.items():
        assert isinstance(true, str) or float(true) in numbers, f"{parameter} = {true}"


def test_every_picture_of_the_gallery_is_shown_by_its_example() -> None:
    files = list((ROOT / "docs" / "images" / "gallery").iterdir())
    assert files
    for file in files:
        assert f"images/gallery/{file.name}" in section(file.stem)


def other(kind: Any, value: Any) -> Any:
    """Another value of a parameter, within its range."""
    if isinstance(kind, Choice):
        return next(one for one in kind.values if one != value)
    if isinstance(kind, Int):
        return value - 1 if value > kind.low else value + 1
    return value + (0.1 if value < (kind.low + kind.high) / 2 else -0.1) * (kind.high - kind.low)


@pytest.mark.parametrize("name", ["part", "plot", "spectrogram"])
def test_every_parameter_changes_the_picture(name: str) -> None:
    if name == "part":
        pytest.importorskip("trimesh")
        pytest.importorskip("manifold3d")
    module = load(name)
    true = np.asarray(module.render(module.TRUTH), float)
    for parameter, kind in module.SPACE.parameters.items():
        changed = {**module.TRUTH, parameter: other(kind, module.TRUTH[parameter])}
        difference = np.abs(np.asarray(module.render(changed), float) - true)
        assert difference.max() > 0.05 * true.max(), parameter
