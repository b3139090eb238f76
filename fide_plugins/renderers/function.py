"""A renderer that is a function of the user: ``FILE.py:NAME`` or ``module:NAME``."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import ModuleType
from typing import Any

from fide_plugins.errors import OptionError, RenderError
from fide_plugins.renderers.keywords import keywords_of
from fide_plugins.renderers.naming import described
from fide_plugins.runtime.registry import Referent, module_fingerprint, shown_traceback, version_of
from fide_plugins.space import Space
from fide_plugins.validation.pixels import is_path
from fide_plugins.validation.points import whole_number


class OwnFolder:
    """Keeps the current folder of a user's code, which may call `os.chdir`, apart from FIDE's.

    All threads of a process have one current folder.  So a block that begins in another thread than
    the main one changes nothing, and is refused if code of the main thread has gone elsewhere.
    """

    def __init__(self) -> None:
        self._left: str | None = None  # None: that of FIDE

    @contextmanager
    def entered(self) -> Iterator[None]:
        """Go where the code was at the end of the last block; go back at the end of this one."""
        if threading.current_thread() is not threading.main_thread():
            if self._left is not None:
                raise OptionError(
                    f"the renderer's code has called os.chdir({self._left!r}), and all threads "
                    "have one current folder: render in processes, or let the code find its files "
                    "without os.chdir (Path(__file__).parent)"
                )
            yield
            return
        before = _current_folder()
        if self._left is not None:
            with suppress(OSError):  # it was removed meanwhile
                os.chdir(self._left)
        try:
            yield
        finally:
            now = _current_folder()
            self._left = None if now == before else now
            if before is not None and now != before:
                os.chdir(before)


def _current_folder() -> str | None:
    try:
        return os.getcwd()
    except OSError:
        return None


_REFERENT = Referent(
    "renderer",
    "function",
    "a function of the parameters",
    "functions",
    "write FILE.py:NAME or module:NAME, such as scene.py:render",
)
_FOLDERS: dict[ModuleType, OwnFolder] = {}  # a module is executed once a process


def _found_from_anywhere(image: Any) -> Any:
    """The image; of files, or a list with some, absolute paths: the function has its own folder."""
    if is_path(image):
        return os.path.abspath(image)
    if isinstance(image, list | tuple) and any(map(is_path, image)):
        return [_found_from_anywhere(one) for one in image]
    return image


class FunctionRenderer:
    """Function of a dictionary of parameters (or of x, see `space`) that returns an image.

    reference: ``FILE.py:NAME`` or ``module:NAME``.  The file is executed as a module, with its
        folder first in the search path for modules, as by ``python FILE.py``.  Modules are also
        searched in the current folder.

    A copy in another process loads the file again there, once a process.  If the file or the
    function calls `os.chdir`, only its own code gets the other folder; it cannot render in threads
    then.

    Raises OptionError (a ValueError) if there is no such file, module or function, or if the file
    raises an exception, whose traceback the error shows.  Calls raise RenderError, with parameters
    and traceback, if the function raises an exception.
    """

    def __init__(self, reference: str) -> None:
        place, self._name = _REFERENT.split(reference)
        self.place = os.path.abspath(place) if place.endswith(".py") else place
        folder = OwnFolder()
        with folder.entered():
            self._module = _REFERENT.load(self.place)
        self._folder = _FOLDERS.setdefault(self._module, folder)
        self._function = _REFERENT.attribute(self._module, self.place, self._name)

    def __call__(self, params: Any, **keywords: Any) -> Any:
        """Image of the parameters; keywords: how fine, of those that the function takes."""
        try:
            with self._folder.entered():
                return _found_from_anywhere(self._function(params, **keywords))
        except (Exception, SystemExit) as error:  # scripts end by sys.exit
            raise RenderError(
                f"{self._name} in {self.place} raised an exception\n"
                f"with the parameters {described(params)}\n{shown_traceback(error, __file__)}"
            ) from None

    @property
    def keywords(self) -> dict[str, Any]:
        """Of the function, see `renderers.keywords`."""
        return keywords_of(self._function)

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
        """Of the file of the function, as it was loaded; None where there is none to read."""
        return module_fingerprint(self._module)

    @property
    def version(self) -> str | None:
        """Attribute `version` of the function, a text; None without one.

        OptionError for anything else.
        """
        return version_of(self._function)

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
