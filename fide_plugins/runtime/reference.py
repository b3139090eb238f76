"""An attribute of a user's file or module, by reference: ``FILE.py:NAME`` or ``module:NAME``."""

from __future__ import annotations

import hashlib
import os
import sys
import traceback
from collections.abc import Callable
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

from fide_plugins.errors import OptionError, UnknownNameError, did_you_mean
from fide_plugins.runtime import fingerprints

__all__ = [
    "Referent",
    "attribute",
    "fingerprint",
    "is_reference",
    "load",
    "shown_traceback",
    "split",
]

_FINGERPRINTS: WeakKeyDictionary[ModuleType, str | None] = WeakKeyDictionary()


class Referent(NamedTuple):
    """What a reference is to: words for errors.

    name: such as "renderer"; word, plural: what it is in Python, such as "function".
    rule: what it must be.
    form: how to write a reference, with an example.
    """

    name: str
    word: str
    rule: str
    plural: str
    form: str


def is_reference(text: str) -> bool:
    """Whether a text has the form of a reference to a function, rather than a name."""
    return ":" in text or text.endswith(".py")


def split(reference: str, referent: Referent) -> tuple[str, str]:
    """File or module, and name; OptionError (a ValueError) unless both are there."""
    place, _, name = reference.rpartition(":")
    if place and name.isidentifier():
        return place, name
    if os.path.isfile(reference):
        names = _names(load(reference, referent), referent)
        raise OptionError(f"{reference} is a file, not a {referent.word}; {names}")
    raise OptionError(f"no {referent.name} {reference!r}; {referent.form}")


def load(place: str, referent: Referent) -> ModuleType:
    """Module in a file, or by its name; loaded once a process.

    The folder of a file becomes the first in the search path for modules, as by ``python FILE.py``.
    Modules are also searched in the current folder.

    Raises OptionError (a ValueError) if there is none, or if it raises an exception, whose
    traceback the error shows.
    """
    module = _import(place, referent) if not place.endswith(".py") else _execute(place, referent)
    if module not in _FINGERPRINTS:  # at once: the file may be edited while this process goes on
        _FINGERPRINTS[module] = _fingerprint(module)
    return module


def fingerprint(module: ModuleType) -> str | None:
    """Kind and digest of the file of a module, as it was when `load` loaded it; None without."""
    return _FINGERPRINTS[module]


def _fingerprint(module: ModuleType) -> str | None:
    file = getattr(module, "__file__", None)
    return None if file is None else fingerprints.of_file(file)


def _execute(place: str, referent: Referent) -> ModuleType:
    """Module in a file."""
    path = os.path.abspath(place)
    name = f"{Path(path).stem}_{hashlib.sha256(path.encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    if not os.path.isfile(path):
        raise OptionError(f"no file {place!r}{_similar_files(path)}; {referent.form}")
    spec = spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None, "a file that ends with .py"
    module = module_from_spec(spec)
    _search_in(os.path.dirname(path), first=True)
    sys.modules[name] = module  # before it is executed: dataclasses look themselves up
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[name]
        raise _unusable(place, error) from None  # the message has its traceback
    return module


def _import(name: str, referent: Referent) -> ModuleType:
    """Module by name, also from the current folder."""
    _search_in(os.getcwd(), first=False)
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and (name == error.name or name.startswith(f"{error.name}.")):
            raise UnknownNameError(f"no module {name!r}; {referent.form}") from None
        raise _unusable(name, error) from None
    except BaseException as error:  # scripts end by sys.exit
        raise _unusable(name, error) from None


def _search_in(folder: str, *, first: bool) -> None:
    if folder not in sys.path:
        sys.path.insert(0 if first else len(sys.path), folder)


def _unusable(place: str, error: BaseException) -> BaseException:
    """Error for a file that raised one; Ctrl-C stays what it is."""
    if isinstance(error, KeyboardInterrupt):
        return error
    return OptionError(
        f"{place} cannot be imported; mend this error in it:\n{shown_traceback(error)}"
    )


def shown_traceback(error: BaseException, caller: str = __file__) -> str:
    """Traceback of an error, from the user's first line; caller: our file that called the user."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [
        f for f in frames if f.filename not in (__file__, caller) and "importlib" not in f.filename
    ]
    shown = traceback.format_list(own) + traceback.format_exception_only(error)
    return "".join(shown).rstrip()


def attribute(module: ModuleType, place: str, name: str, referent: Referent) -> Callable[..., Any]:
    """Callable `name` of a module at `place`; OptionError (a ValueError) without."""
    if not hasattr(module, name):
        hint = did_you_mean(name, _functions(module))
        raise OptionError(f"{place} has no {name!r}; {_names(module, referent)}{hint}")
    found = getattr(module, name)
    if not callable(found):
        raise OptionError(
            f"{name!r} in {place} is {type(found).__name__}, not {referent.rule}; "
            f"{_names(module, referent)}"
        )
    return found  # type: ignore[no-any-return]


def _functions(module: ModuleType) -> list[str]:
    """Names of the functions that were written in the module."""
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and callable(value)
        and getattr(value, "__module__", None) == module.__name__
    ]


def _names(module: ModuleType, referent: Referent) -> str:
    names = _functions(module)
    return f"its {referent.plural}: {', '.join(names)}" if names else f"it has no {referent.plural}"


def _similar_files(path: str) -> str:
    folder = os.path.dirname(path)
    files = [p.name for p in Path(folder).glob("*.py")] if os.path.isdir(folder) else []
    return did_you_mean(os.path.basename(path), files)
