"""The extras named in errors are those of the distribution."""

from __future__ import annotations

import importlib.metadata
import re
import tomllib
from pathlib import Path

import pytest

from fide_plugins.runtime.machine import EXTRAS, missing

REQUIREMENT = re.compile(r"([\w.-]+)[^;]*; extra == ['\"]([\w-]+)['\"]")
NAME = re.compile(r"[\w.-]+")
PROJECT = Path(__file__).parents[2] / "pyproject.toml"
NOT_FOR_USERS = {"all", "dev", "docs", "release"}


def declared() -> dict[str, set[str]]:
    """Packages of each extra; by the project's file, which an installation may be older than."""
    found: dict[str, set[str]] = {}
    if PROJECT.exists():
        project = tomllib.loads(PROJECT.read_text("utf-8"))["project"]
        for extra, packages in project["optional-dependencies"].items():
            names = [match[0].lower() for package in packages if (match := NAME.match(package))]
            found[extra] = set(names)
        return found
    for requirement in importlib.metadata.requires("fide-plugins") or []:
        if match := REQUIREMENT.match(requirement):
            found.setdefault(match[2], set()).add(match[1].lower())
    return found


def test_the_extras_are_those_that_are_declared() -> None:
    found = declared()
    ours = {extra: {name.lower() for name in packages} for extra, packages in EXTRAS.items()}
    assert ours == {name: found[name] for name in found.keys() - NOT_FOR_USERS}
    assert "matplotlib" in found["dev"]


@pytest.mark.parametrize("extra", EXTRAS)
def test_the_error_names_packages_first_and_then_the_extra(extra: str) -> None:
    words = f"x: pip install {' '.join(EXTRAS[extra])} (or this distribution with its extra {extra}"
    assert str(missing(extra, "x")) == f"{words}: pip install 'fide-plugins[{extra}]')"


def test_one_package_of_an_extra() -> None:
    assert str(missing("dinov3", "x", "safetensors")).startswith("x: pip install safetensors (or")
