"""The extras named in errors are those of the distribution."""

from __future__ import annotations

import importlib.metadata
import re

import pytest

from fide_plugins.runtime.machine import EXTRAS, missing

REQUIREMENT = re.compile(r"([\w.-]+)[^;]*; extra == ['\"]([\w-]+)['\"]")
NOT_FOR_USERS = {"all", "dev", "docs"}


def test_the_extras_are_those_of_the_metadata() -> None:
    found: dict[str, set[str]] = {}
    for requirement in importlib.metadata.requires("fide-plugins") or []:
        if match := REQUIREMENT.match(requirement):
            found.setdefault(match[2], set()).add(match[1].lower())
    ours = {extra: {name.lower() for name in packages} for extra, packages in EXTRAS.items()}
    assert ours == {name: found[name] for name in found.keys() - NOT_FOR_USERS}


@pytest.mark.parametrize("extra", EXTRAS)
def test_the_error_names_packages_first_and_then_the_extra(extra: str) -> None:
    words = f"x: pip install {' '.join(EXTRAS[extra])} (or this distribution with its extra {extra}"
    assert str(missing(extra, "x")) == f"{words}: pip install 'fide-plugins[{extra}]')"


def test_one_package_of_an_extra() -> None:
    assert str(missing("dinov3", "x", "safetensors")).startswith("x: pip install safetensors (or")
