"""The only place that looks for the laboratory, the package `fide_lab`, and loads of it by name."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from fide_plugins.errors import DependencyError

__all__ = ["is_here", "keep_old_name", "module"]

_ROOT = "fide_lab"


def is_here() -> bool:
    """Whether the laboratory can be imported."""
    return find_spec(_ROOT) is not None


def module(name: str = "") -> Any:
    """Module of the laboratory, such as "optimizers"; "" for the package itself.

    Raises DependencyError (an ImportError) where the laboratory is not installed.
    """
    if not is_here():
        raise DependencyError(
            f"{_ROOT} (rivals, runs of built-in tasks, comparisons, reports) is not installed: "
            "install the whole of FIDE, or add its folder lab to PYTHONPATH"
        )
    return import_module(f"{_ROOT}.{name}".rstrip("."))


def keep_old_name(old: str, name: str = "") -> None:
    """Let module `old`, and modules below it, stand for those of the laboratory.

    Nothing is loaded before something of it is used.
    """
    sys.modules[old] = _OldName(old, name)
    where = Path(module().__path__[0], *filter(None, [name]))
    for path in where.rglob("*.py"):
        below = ".".join(path.relative_to(where).with_suffix("").parts).removesuffix("__init__")
        if below := below.rstrip("."):
            sys.modules[f"{old}.{below}"] = _OldName(
                f"{old}.{below}", f"{name}.{below}".lstrip(".")
            )


class _OldName(ModuleType):
    """A module by its old name; what it has is that of the module by its new name."""

    def __init__(self, old: str, name: str) -> None:
        super().__init__(old, f"Old name of `{_ROOT}.{name}`.")
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        found = module(self._name)
        if not hasattr(found, attribute) and f"{self.__name__}.{attribute}" in sys.modules:
            return module(f"{self._name}.{attribute}".lstrip("."))
        return getattr(found, attribute)
