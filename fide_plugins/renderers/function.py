"""A renderer that is a function of the user: ``FILE.py:NAME`` or ``module:NAME``."""

from __future__ import annotations

import hashlib
import os
import sys
import traceback
from collections.abc import Callable
from difflib import get_close_matches
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

from fide_plugins.errors import OptionError, RenderError
from fide_plugins.renderers.fingerprint import digest
from fide_plugins.renderers.naming import described
from fide_plugins.space import Space
from fide_plugins.validation.points import whole_number

__all__ = ["FunctionRenderer", "is_reference"]

_FORM = "write FILE.py:NAME or module:NAME, such as scene.py:render"


class FunctionRenderer:
    """Function of a dictionary of parameters (or of x, see `space`) that returns an image.

    reference: ``FILE.py:NAME`` or ``module:NAME``.  The file is executed as a module, with its
        folder first in the search path for modules, as by ``python FILE.py``.  Modules are also
        searched in the current folder.

    A copy in another process loads the file again there, once a process.

    Raises OptionError (a ValueError) if there is no such file, module or function, or if the file
    raises an exception, whose traceback the error shows.  Calls raise RenderError, with parameters
    and traceback, if the function raises an exception.
    """

    def __init__(self, reference: str) -> None:
        place, self._name = _split(reference)
        self.place = os.path.abspath(place) if place.endswith(".py") else place
        self._module = _load(self.place)
        self._function = _function(self._module, self.place, self._name)

    def __call__(self, params: Any) -> Any:
        """Image of the parameters."""
        try:
            return self._function(params)
        except (Exception, SystemExit) as error:  # scripts end by sys.exit
            raise RenderError(
                f"{self._name} in {self.place} raised an exception\n"
                f"with the parameters {described(params)}\n{_traceback(error)}"
            ) from None

    @property
    def reference(self) -> str:
        """The reference, with an absolute path."""
        return f"{self.place}:{self._name}"

    @property
    def name(self) -> str:
        """The reference without folders."""
        return f"{os.path.basename(self.place)}:{self._name}"

    @property
    def fingerprint(self) -> str | None:
        """Of the file of the function; None where it has none that can be read."""
        file = getattr(self._module, "__file__", None)
        try:
            return None if file is None else digest("file", Path(file).read_bytes())
        except OSError:
            return None

    @property
    def space(self) -> Space | int | None:
        """What the user declared beside the function; None if nothing.

        It is the attribute `space` of the function or else of its module: a `Space`, or the number
        of parameters for a function of x, (dim,) in [0, 1].  OptionError for anything else.
        """
        space = getattr(self._function, "space", getattr(self._module, "space", None))
        if space is None or isinstance(space, Space):
            return space
        try:
            return whole_number("space", space, 1)
        except ValueError:
            raise OptionError(
                f"the space of {self.reference} must be a Space, or the number of parameters, "
                f"not {space!r}"
            ) from None

    def space_or(self, given: Space | None) -> Space | int:
        """The space that was given, or else the one beside the function; OptionError without."""
        space = self.space if given is None else given
        if space is None:
            raise OptionError(
                f"the parameters of {self.name} are unknown; write space = Space(...) in that "
                "file, or name a file of them: --space FILE.toml"
            )
        return space

    def __reduce__(self) -> tuple[Any, ...]:
        return FunctionRenderer, (self.reference,)

    def __repr__(self) -> str:
        return f"FunctionRenderer({self.reference!r})"


def is_reference(text: str) -> bool:
    """Whether a text has the form of a reference to a function, rather than a name."""
    return ":" in text or text.endswith(".py")


def _split(reference: str) -> tuple[str, str]:
    """File or module, and name; OptionError unless both are there."""
    place, _, name = reference.rpartition(":")
    if place and name.isidentifier():
        return place, name
    if os.path.isfile(reference):
        raise OptionError(f"{reference} is a file, not a function; {_names(_load(reference))}")
    raise OptionError(f"no renderer {reference!r}; {_FORM}")


def _load(place: str) -> ModuleType:
    """Module in a file, or by its name; loaded once a process."""
    if not place.endswith(".py"):
        return _import(place)
    path = os.path.abspath(place)
    name = f"{Path(path).stem}_{hashlib.sha256(path.encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    if not os.path.isfile(path):
        raise OptionError(f"no file {place!r}{_similar_files(path)}; {_FORM}")
    spec = spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None, "a file that ends with .py"
    module = module_from_spec(spec)
    _search_in(os.path.dirname(path), first=True)
    sys.modules[name] = module  # before it is executed: dataclasses look themselves up
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[name]
        raise _unusable(place, error) from error
    return module


def _import(name: str) -> ModuleType:
    """Module by name, also from the current folder."""
    _search_in(os.getcwd(), first=False)
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and (name == error.name or name.startswith(f"{error.name}.")):
            raise OptionError(f"no module {name!r}; {_FORM}") from None
        raise _unusable(name, error) from error
    except Exception as error:
        raise _unusable(name, error) from error


def _search_in(folder: str, *, first: bool) -> None:
    if folder not in sys.path:
        sys.path.insert(0 if first else len(sys.path), folder)


def _unusable(place: str, error: BaseException) -> BaseException:
    """Error for a file that raised one; Ctrl-C stays what it is."""
    if isinstance(error, KeyboardInterrupt):
        return error
    return OptionError(f"{place} cannot be imported; mend this error in it:\n{_traceback(error)}")


def _traceback(error: BaseException) -> str:
    """Traceback of an error, from the user's first line."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if f.filename != __file__ and "importlib" not in f.filename]
    shown = traceback.format_list(own) + traceback.format_exception_only(error)
    return "".join(shown).rstrip()


def _function(module: ModuleType, place: str, name: str) -> Callable[[Any], Any]:
    if not hasattr(module, name):
        close = get_close_matches(name, _functions(module), n=1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise OptionError(f"{place} has no {name!r}; {_names(module)}{hint}")
    function = getattr(module, name)
    if not callable(function):
        raise OptionError(
            f"{name!r} in {place} is {type(function).__name__}, not a function of the parameters; "
            f"{_names(module)}"
        )
    return function  # type: ignore[no-any-return]


def _functions(module: ModuleType) -> list[str]:
    """Names of the functions that were written in the module."""
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and callable(value)
        and getattr(value, "__module__", None) == module.__name__
    ]


def _names(module: ModuleType) -> str:
    names = _functions(module)
    return f"its functions: {', '.join(names)}" if names else "it has no functions"


def _similar_files(path: str) -> str:
    folder = os.path.dirname(path)
    files = [p.name for p in Path(folder).glob("*.py")] if os.path.isdir(folder) else []
    close = get_close_matches(os.path.basename(path), files, n=1)
    return f"; did you mean {close[0]!r}?" if close else ""
