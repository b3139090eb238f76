"""The only place that looks for the laboratory, the package `fide_lab`, and loads of it by name."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from fide_plugins.errors import DependencyError

_ROOT = "fide_lab"


def is_installed() -> bool:
    """Whether the laboratory can be imported."""
    return find_spec(_ROOT) is not None


def module(name: str = "") -> Any:
    """Module of the laboratory, such as "optimizers"; "" for the package itself.

    Raises DependencyError (an ImportError) where the laboratory is not installed.
    """
    if not is_installed():
        raise DependencyError(
            f"{_ROOT} (figures, pages of runs, rivals, comparisons) is not installed: "
            "install the whole of FIDE, or add its folder lab to PYTHONPATH"
        )
    return import_module(f"{_ROOT}.{name}".rstrip("."))


def keep_old_name(old: str, new: str = _ROOT) -> None:
    """Let module `old` stand for `new`, which is loaded when something of it is used.

    Raises DependencyError as `module`.
    """
    module()

    class OldName(ModuleType):
        def __getattr__(self, attribute: str) -> Any:
            return getattr(import_module(new), attribute)

    sys.modules[old] = OldName(old, f"Old name of `{new}`.")
