"""Optimizers that misbehave, and a comparison small enough to be run often."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fide_lab import optimizers
from fide_lab.baselines.evolution import Random
from fide_lab.compare import Configuration, Plan

SMALL = Plan(
    ("voronoi",),
    (Configuration.parse("cma"), Configuration.parse("random")),
    seeds=2,
    budget=40,
    size=16,
    task_options={"cells": 2},
    metrics=("mse", "loi"),
)


def small(*configurations: str, **changes: Any) -> Plan:
    """The small plan, with other optimizers if named and other settings."""
    named = tuple(map(Configuration.parse, configurations)) or SMALL.configurations
    return replace(SMALL, configurations=named, **changes)


class Raises(Random):
    """Fails as soon as it has been told something."""

    mended = False

    def tell(self, X: object, images: object = None, losses: object = None) -> None:
        if not self.mended:
            raise ArithmeticError("singular <matrix>")
        super().tell(X, images, losses)


class Astray(Random):
    """Leaves the box."""

    def ask(self, n: int | None = None) -> Any:
        return super().ask(n) + 1.0


class Nowhere(Random):
    """Asks for NaN."""

    def ask(self, n: int | None = None) -> Any:
        return np.full_like(super().ask(n), np.nan)


@pytest.fixture
def misbehaving(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[Raises]]:
    """Makes "raises", "astray" and "nowhere" known."""
    names = {"raises": Raises, "astray": Astray, "nowhere": Nowhere}
    for name, cls in names.items():
        optimizers.register(name, cls)
    yield Raises
    monkeypatch.undo()
    Raises.mended = False
    for name in names:
        optimizers._REGISTRY._factories.pop(name)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, and what is in it."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}
