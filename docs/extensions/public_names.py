"""The build fails where the reference lacks a public name: one in the `__all__` of a public module.

So it does where the docstring of a public function or method is missing, does not name a parameter,
or does not say that it raises the errors that are raised in its own lines.  The docstring of a
class must also say that it raises errors if that of one of its bases says so.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from importlib import import_module
from typing import Any

MODULES = {
    "fide_plugins": "fide_plugins",
    "fide_lab.baselines": "fide_lab.baselines",
    "fide_plugins.checkpoint": "fide_plugins.runtime.checkpoint",
    "fide_lab.compare": "fide_lab.compare",
    "fide_plugins.encoders": "fide_plugins.encoders",
    "fide_plugins.errors": "fide_plugins.errors",
    "fide_lab.run": "fide_lab.run",
    "fide_plugins.images": "fide_plugins.validation.images",
    "fide_plugins.losses": "fide_plugins.losses",
    "fide_lab.optimizers": "fide_lab.optimizers",
    "fide_lab.report": "fide_lab.report",
    "fide_plugins.renderers": "fide_plugins.renderers",
    "fide_plugins.fitting.callbacks": "fide_plugins.fitting.callbacks",
    "fide_plugins.learning": "fide_plugins.learning",
    "fide_lab.watch": "fide_lab.watch",
    "fide_adapters.nevergrad": "fide_adapters.nevergrad",
    "fide_adapters.optuna": "fide_adapters.optuna",
    "fide_tasks": "fide_tasks",
}
"""Public modules, by the name that users type, and where they are."""


def setup(app: Any) -> dict[str, Any]:
    """Register the check with Sphinx."""
    app.connect("env-check-consistency", _check)
    return {"parallel_read_safe": True}


def _check(app: Any, env: Any) -> None:
    from sphinx.util import logging  # in here: the tests of this module need no Sphinx

    log = logging.getLogger(__name__)
    known = set(env.domains["py"].objects)
    for name, obj in public():
        shorter = f"fide_plugins.{obj.__name__}"  # what the package itself offers
        if not known & {name, shorter, f"{obj.__module__}.{obj.__qualname__}"}:
            log.warning("the reference lacks the public name %s", name)
    for gap in gaps():
        log.warning(gap)


def gaps() -> Iterator[str]:
    """What docstrings of public names and their methods do not say."""
    for name, obj in public():
        yield from _gaps(name, obj, _text(obj))
        for method in _methods(obj) if inspect.isclass(obj) else ():
            yield from _gaps(f"{name}.{method.__name__}", method, method.__doc__ or "")


def _gaps(name: str, obj: Any, text: str) -> Iterator[str]:
    if not obj.__doc__:
        yield f"{name} has no docstring"
    for parameter in undocumented(obj, text):
        yield f"the docstring of {name} does not name its parameter {parameter!r}"
    errors = raised(obj)
    if errors and not _says_errors(text):
        yield f"the docstring of {name} does not say that it raises {' or '.join(sorted(errors))}"
    elif _hides_errors(obj):
        yield f"the docstring of {name} does not say that it raises the errors of its bases"


def public() -> Iterator[tuple[str, Any]]:
    """Public classes and functions, by the name that users type."""
    for shown, where in MODULES.items():
        module = import_module(where)
        for name in module.__all__:
            obj = getattr(module, name)
            if inspect.isclass(obj) or inspect.isfunction(obj):
                yield f"{shown}.{name}", obj


def _methods(cls: type) -> Iterator[Any]:
    """Public methods that a class defines itself, but for those that another library declares."""
    foreign = [one for one in cls.__mro__[1:] if not one.__module__.startswith("fide_")]
    for name, member in vars(cls).items():
        method = getattr(member, "__func__", member)  # of a class method, or a static one
        is_public = inspect.isfunction(method) and not name.startswith("_")
        if is_public and not any(hasattr(one, name) for one in foreign):
            yield method


def _text(obj: Any) -> str:
    """Docstring of a function; of a class, with those of its bases."""
    where = inspect.getmro(obj) if inspect.isclass(obj) else (obj,)
    return " ".join(one.__doc__ or "" for one in where)


def _says_errors(text: str) -> bool:
    return bool(re.search(r"\w*Error|[Rr]aise|refuse", text))


def _hides_errors(obj: Any) -> bool:
    """Whether only the bases of a class, and not its own docstring, say that it raises errors."""
    if not inspect.isclass(obj) or issubclass(obj, Exception):
        return False
    bases = [one for one in obj.__mro__[1:] if one.__module__.startswith("fide_")]
    inherited = any(_says_errors(one.__doc__ or "") for one in bases)
    return inherited and not _says_errors(obj.__doc__ or "")


def undocumented(obj: Any, text: str) -> list[str]:
    """Parameters of a public function, or of a class, that a text does not name."""
    if inspect.isclass(obj) and issubclass(obj, Exception):
        return []
    names = inspect.signature(obj).parameters
    said = set(re.findall(r"\w+", text)) | {"self", "cls"}
    return [name for name in names if name not in said]


def raised(obj: Any) -> set[str]:
    """Errors that a function, or the `__init__` of a class, raises in its own lines."""
    function = inspect.unwrap(vars(obj).get("__init__", obj) if inspect.isclass(obj) else obj)
    if not inspect.isfunction(function) or "<string>" in function.__code__.co_filename:
        return set()  # the `__init__` of a dataclass has no lines
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    made = [node.exc for node in ast.walk(tree) if isinstance(node, ast.Raise)]
    called = [one.func for one in made if isinstance(one, ast.Call)]
    return {one.id for one in called if isinstance(one, ast.Name)}
