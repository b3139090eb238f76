"""Every optimizer by name: FIDE, its rivals, and what others register.

    >>> from fide_plugins import optimizers
    >>> optimizers.names()
    ['cma', 'fide', 'random']
    >>> opt = optimizers.make("cma", 3, popsize=8, seed=0)
    >>> opt.ask().shape
    (8, 3)

Importing this module imports none of them.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

from fide_plugins.errors import OptionError, UnknownNameError

if TYPE_CHECKING:
    from fide_plugins.protocols import Optimizer

__all__ = ["load", "make", "names", "options", "register"]

_CLASSES: dict[str, Callable[..., Optimizer] | str] = {
    "cma": "fide_plugins.baselines.cma:CMA",
    "fide": "fide_plugins.fide:FIDE",
    "random": "fide_plugins.baselines.random:Random",
}


def names() -> list[str]:
    """Names of all optimizers, sorted."""
    return sorted(_CLASSES)


def register(name: str, cls: Callable[..., Optimizer] | str) -> None:
    """Make the class `cls`, or the one at ``"module:attribute"``, known by `name`."""
    _CLASSES[name] = cls


def make(name: str, dim: int, target: object = None, **settings: Any) -> Optimizer:
    """Optimizer `name` over [0, 1]^dim for `target`, with its own `settings`.

    Raises UnknownNameError, or OptionError listing the options there are (both ValueErrors).
    """
    cls = _resolve(name)
    known = options(name)
    unknown = sorted(set(settings) - set(known)) if known else []
    if unknown:
        listed = ", ".join(known)
        raise OptionError(f"{name} has no option {unknown[0]!r}; its options: {listed}")
    optimizer: Optimizer = cls(dim, target, **settings)
    return optimizer


def load(name: str, path: str | os.PathLike[str]) -> Optimizer:
    """Optimizer `name` as it was saved at `path`."""
    loaded: Optimizer = _resolve(name).load(path)
    return loaded


def options(name: str) -> list[str]:
    """Names of the options of optimizer `name`; empty where it takes any."""
    known: set[str] = set()
    classes: tuple[Any, ...] = inspect.getmro(_resolve(name))
    for base in classes:  # an __init__ with **options hands them to the next class
        parameters = inspect.signature(base.__init__).parameters.values()
        known.update(p.name for p in parameters if p.kind is p.KEYWORD_ONLY)
        if all(p.kind is not p.VAR_KEYWORD for p in parameters):
            return sorted(known)
    return []


def _resolve(name: str) -> Any:
    entry = _CLASSES.get(name) if isinstance(name, str) else None
    if entry is None:
        raise UnknownNameError.of("optimizer", name, _CLASSES)
    if isinstance(entry, str):
        module, attribute = entry.split(":")
        entry = _CLASSES[name] = getattr(import_module(module), attribute)
    return entry
