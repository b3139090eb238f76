"""The only place that looks for the laboratory, the package `fide_lab`, and loads of it by name."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
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
            f"{_ROOT} (rivals, runs of built-in tasks, comparisons, reports) is not installed: "
            "install the whole of FIDE, or add its folder lab to PYTHONPATH"
        )
    return import_module(f"{_ROOT}.{name}".rstrip("."))


def keep_old_name(old: str, new: str = _ROOT) -> None:
    """Let module `old`, and modules below it, stand for `new`, of the laboratory or not.

    Nothing is loaded before something of it is used.  Raises DependencyError as `module`.
    """
    module()
    spec = find_spec(new)
    sys.modules[old] = _OldName(old, new)
    for where in (spec and spec.submodule_search_locations) or ():
        for path in Path(where).rglob("*.py"):
            parts = path.relative_to(where).with_suffix("").parts
            below = "".join(f".{part}" for part in parts if part != "__init__")
            if below:
                sys.modules[old + below] = _OldName(old + below, new + below)


class _OldName(ModuleType):
    """A module by its old name; what it has is that of the module by its new name."""

    def __init__(self, old: str, new: str) -> None:
        super().__init__(old, f"Old name of `{new}`.")
        self._new = new

    def __getattr__(self, attribute: str) -> Any:
        found = import_module(self._new)
        below = sys.modules.get(f"{self.__name__}.{attribute}")
        if below is not None and not hasattr(found, attribute):
            return below
        return getattr(found, attribute)
