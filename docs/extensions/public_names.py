"""The build fails where the reference lacks a public name: one in the `__all__` of a public module.

A parameter that the docstring of a public function does not name is such a gap, too.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from importlib import import_module
from typing import Any

from sphinx.util import logging

MODULES = {
    "fide_plugins": "fide_plugins",
    "fide_plugins.baselines": "fide_plugins.baselines",
    "fide_plugins.checkpoint": "fide_plugins.runtime.checkpoint",
    "fide_plugins.compare": "fide_plugins.experiments.compare",
    "fide_plugins.encoders": "fide_plugins.encoders",
    "fide_plugins.errors": "fide_plugins.errors",
    "fide_plugins.harness": "fide_plugins.experiments.run",
    "fide_plugins.images": "fide_plugins.validation.images",
    "fide_plugins.losses": "fide_plugins.losses",
    "fide_plugins.optimizers": "fide_plugins.optimizers",
    "fide_plugins.report": "fide_plugins.experiments.report",
    "fide_plugins.renderers": "fide_plugins.renderers",
    "fide_plugins.fitting.callbacks": "fide_plugins.fitting.callbacks",
    "fide_plugins.learning": "fide_plugins.learning",
    "fide_plugins.watch": "fide_plugins.watch",
    "fide_adapters.nevergrad": "fide_adapters.nevergrad",
    "fide_adapters.optuna": "fide_adapters.optuna",
    "fide_tasks": "fide_tasks",
}
"""Public modules, by the name that users type, and where they are."""

_log = logging.getLogger(__name__)


def setup(app: Any) -> dict[str, Any]:
    """Register the check with Sphinx."""
    app.connect("env-check-consistency", _check)
    return {"parallel_read_safe": True}


def _check(app: Any, env: Any) -> None:
    known = set(env.domains["py"].objects)
    for name, obj in public():
        shorter = f"fide_plugins.{obj.__name__}"  # what the package itself offers
        if not known & {name, shorter, f"{obj.__module__}.{obj.__qualname__}"}:
            _log.warning("the reference lacks the public name %s", name)
        for parameter in undocumented(obj):
            _log.warning("the docstring of %s does not name its parameter %r", name, parameter)


def public() -> Iterator[tuple[str, Any]]:
    """Public classes and functions, by the name that users type."""
    for shown, where in MODULES.items():
        module = import_module(where)
        for name in module.__all__:
            obj = getattr(module, name)
            if inspect.isclass(obj) or inspect.isfunction(obj):
                yield f"{shown}.{name}", obj


def undocumented(obj: Any) -> list[str]:
    """Parameters of a public function, or of a class, that no docstring of it names."""
    if inspect.isclass(obj) and issubclass(obj, Exception):
        return []
    where = inspect.getmro(obj) if inspect.isclass(obj) else (obj,)
    text = " ".join(one.__doc__ or "" for one in where)
    return [name for name in inspect.signature(obj).parameters if name not in text]
