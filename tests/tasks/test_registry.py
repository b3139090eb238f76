"""The registry: names, options, laziness, and what a user mistypes."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

import fide_tasks
from fide_tasks import Task


def test_names_are_sorted_and_can_all_be_made() -> None:
    names = fide_tasks.names()
    assert names == sorted(names)
    assert {"spline", "voronoi"} <= set(names)
    for name in ("spline", "voronoi"):
        task = fide_tasks.make(name, size=16)
        assert isinstance(task, Task)
        assert task.name == name


def test_options_with_their_defaults() -> None:
    assert fide_tasks.options("voronoi") == {"cells": None, "variant": "color", "target": None}
    assert fide_tasks.options("spline") == {"control_points": 7, "target": "ampersand"}


def test_unknown_task_lists_the_known() -> None:
    with pytest.raises(ValueError, match="no task is named 'voroni'; .*spline.*voronoi"):
        fide_tasks.make("voroni")


def test_unknown_option_lists_the_known() -> None:
    with pytest.raises(ValueError, match="voronoi has no option 'cels'.*cells, target, variant"):
        fide_tasks.make("voronoi", cels=3)


@pytest.mark.parametrize(
    ("name", "arguments", "rule"),
    [
        ("voronoi", {"cells": 0}, "cells must be a whole number >= 1, not 0"),
        ("voronoi", {"cells": "8"}, "cells must be a whole number >= 1, not '8'"),
        ("voronoi", {"variant": "colour"}, "variant must be one of 'color', 'distance'"),
        ("voronoi", {"size": 0}, "size must be a whole number >= 1"),
        ("voronoi", {"size": (64, 64, 3)}, r"size must be one number or \(height, width\)"),
        ("voronoi", {"seed": -1}, "seed must be a whole number >= 0"),
        ("spline", {"control_points": 1}, "control_points must be a whole number >= 2"),
        ("sprites", {"sprites": 2.5}, "sprites must be a whole number >= 1, not 2.5"),
        ("triangles", {"triangles": 1}, "triangles must be a whole number >= 2, not 1"),
        ("triangles", {"target": "face"}, "target must be one of 'photograph', 'random'"),
    ],
)
def test_values_outside_their_range(name: str, arguments: dict[str, Any], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        fide_tasks.make(name, **arguments)


def test_no_task_needs_the_optimizer_or_torch() -> None:
    code = (
        "import sys, fide_tasks\n"
        "for name in ('spline', 'voronoi'):\n"
        "    fide_tasks.make(name, size=16).target\n"
        "print([m for m in ('torch', 'fide_plugins') if m in sys.modules])"
    )
    path = [p for p in sys.path if p]
    script = f"import sys; sys.path[:0] = {path}\n{code}"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert result.stdout.strip() == "[]", result.stderr
