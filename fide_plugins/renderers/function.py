"""A renderer that is a function of the user: ``FILE.py:NAME`` or ``module:NAME``."""

from __future__ import annotations

import os
from functools import cached_property
from typing import Any

from fide_plugins.errors import OptionError, RenderError
from fide_plugins.renderers.keywords import keywords_of, missing_from
from fide_plugins.renderers.naming import described
from fide_plugins.runtime.registry import Referent, module_fingerprint, shown_traceback, version_of
from fide_plugins.space import Space
from fide_plugins.validation.points import number_of_parameters

_REFERENT = Referent(
    "renderer",
    "a function of the parameters",
    "write FILE.py:NAME or module:NAME, such as scene.py:render",
)


class FunctionRenderer:
    """Function of a dictionary of parameters (or of x, see `space`) that returns an image.

    reference: ``FILE.py:NAME`` or ``module:NAME``.  The file is executed as a module, with its
        folder first in the search path for modules, as by ``python FILE.py``.  Modules are also
        searched in the current folder.

    A copy in another process loads the file again there, once a process.

    Raises OptionError (a ValueError) if there is no such file, module or function, if the file
    raises an exception, whose traceback the error shows, or if it calls `os.chdir`.  Calls raise
    RenderError, with parameters and traceback, if the function raises an exception.
    """

    def __init__(self, reference: str) -> None:
        place, self._name = _REFERENT.split(reference)
        self.place = os.path.abspath(place) if place.endswith(".py") else place
        folder = os.getcwd()
        self._module = _REFERENT.load(self.place)
        if os.getcwd() != folder:
            os.chdir(folder)
            raise OptionError(
                f"{self.place} calls os.chdir, which moves the whole process; let it find its "
                "files by Path(__file__).parent"
            )
        self._function = _REFERENT.attribute(self._module, self.place, self._name)

    def __call__(self, params: Any, **keywords: Any) -> Any:
        """Image of the parameters; keywords: how fine, of those that the function takes."""
        keywords = {**missing_from(self.keywords), **keywords}
        try:
            return self._function(params, **keywords)
        except (Exception, SystemExit) as error:  # scripts end by sys.exit
            raise RenderError(
                f"{self._name} in {self.place} raised an exception\n"
                f"with the parameters {described(params)}\n{shown_traceback(error, __file__)}"
            ) from None

    @cached_property
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
        """Attribute `version` of the function, a text; None without one."""
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
        return number_of_parameters(f"the space of {self.reference}", space)

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
