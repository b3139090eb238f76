"""What users name or hand over: factories by name, attributes of their files, their functions.

A renderer is known again by a version, which the user states, or else by a fingerprint of its
source with its kind, such as "file:0123456789abcdef".
"""

from __future__ import annotations

import hashlib
import inspect
import os
import sys
import tokenize
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from fide_plugins.errors import FideError, OptionError, UnknownNameError, did_you_mean
from fide_plugins.types import Float32

T = TypeVar("T")


class Registry(Generic[T]):
    """Factories by name.

    A factory is a callable, or the string ``"package.module:attribute"`` of one, which is imported
    when the name is first used: listing names imports nothing.  A factory with an option `variant`
    also accepts ``"name:variant"``.

    kind: what they make, for errors.  patterns: names that somebody else understands, for errors.
    """

    def __init__(self, kind: str, patterns: Sequence[str] = ()) -> None:
        self._kind, self._patterns = kind, patterns
        self._factories: dict[str, Callable[..., T] | str] = {}

    def register(self, name: str, factory: Callable[..., T] | str) -> None:
        """Add `factory` under `name`, or replace the factory of that name."""
        if not (isinstance(name, str) and name.isprintable() and name.strip() and ":" not in name):
            raise OptionError(
                f"the name of a {self._kind} is a printable string without a colon, got {name!r}"
            )
        if not callable(factory) and not (isinstance(factory, str) and factory.count(":") == 1):
            raise OptionError(
                f"the factory of {self._kind} {name!r} is a callable or 'module:attribute', "
                f"got {factory!r}"
            )
        self._factories[name] = factory

    def names(self) -> list[str]:
        """Return all names, sorted."""
        return sorted(self._factories)

    def resolve(self, name: str) -> Callable[..., T]:
        """Return the factory called `name`; raises `UnknownNameError` if there is none."""
        factory = self._factories.get(name) if isinstance(name, str) else None
        if factory is None:
            known = [*self._factories, *self._patterns]
            raise UnknownNameError.of(self._kind, name, known)
        if isinstance(factory, str):
            module, attribute = factory.split(":")
            imported: Callable[..., T] = getattr(import_module(module), attribute)
            factory = self._factories[name] = imported
        return factory

    def knows(self, name: str) -> bool:
        """Whether there is a factory called `name`, or `name` without its variant."""
        return name.partition(":")[0] in self._factories

    def takes(self, name: str, option: str) -> bool:
        """Whether the factory called `name`, a variant aside, has an option of that name."""
        return option in inspect.signature(self.resolve(name.partition(":")[0])).parameters

    def make(self, name: str, *args: object, **options: object) -> T:
        """Call the factory called `name`, which may end with a colon and a variant.

        Raises UnknownNameError, OptionError for an option or a variant that it does not have, and
        what the factory raises.
        """
        first, colon, variant = name.partition(":") if isinstance(name, str) else (name, "", "")
        factory = self.resolve(first)
        self._check(first, factory, len(args), options)
        if colon and not self.takes(first, "variant"):
            raise OptionError(f"the {self._kind} {first!r} has no variants, got {name}")
        return factory(*args, **({"variant": variant} if colon else {}), **options)

    def _check(
        self, name: str, factory: Callable[..., T], n: int, options: dict[str, object]
    ) -> None:
        """Raise OptionError for an option that the factory lacks; its first n come by position."""
        try:
            parameters = list(inspect.signature(factory).parameters.values())
        except ValueError:  # some functions of C do not say
            return
        if any(p.kind is p.VAR_KEYWORD for p in parameters):
            return
        named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
        known = [p.name for p in parameters[n:] if p.kind in named]
        if unknown := sorted(options.keys() - set(known)):
            raise OptionError(
                f"the {self._kind} {name!r} has no option {unknown[0]!r}; it has: "
                f"{', '.join(known) or 'none'}"
            )


# -- attributes of a user's file or module ---------------------------------------------------------

_FINGERPRINTS: WeakKeyDictionary[ModuleType, str | None] = WeakKeyDictionary()


def is_reference(text: str) -> bool:
    """Whether a text has the form of a reference to a function, rather than a name."""
    return ":" in text or text.endswith(".py")


@dataclass(frozen=True, slots=True)
class Referent:
    """What references are to, by words for errors, and how to follow them.

    name: such as "renderer"; word, plural: what it is in Python, such as "function".  rule: what it
    must be.  form: how to write a reference, with an example.  All errors are OptionErrors.
    """

    name: str
    word: str
    rule: str
    plural: str
    form: str

    def split(self, reference: str) -> tuple[str, str]:
        """File or module, and name."""
        place, _, name = reference.rpartition(":")
        if place and name.isidentifier():
            return place, name
        if os.path.isfile(reference):
            names = self._names(self.load(reference))
            raise OptionError(f"{reference} is a file, not a {self.word}; {names}")
        raise OptionError(f"no {self.name} {reference!r}; {self.form}")

    def load(self, place: str) -> ModuleType:
        """Module in a file, or by its name; loaded once a process, see `FunctionRenderer`."""
        module = self._execute(place) if place.endswith(".py") else self._import(place)
        if module not in _FINGERPRINTS:  # at once: the file may be edited while this process runs
            file = getattr(module, "__file__", None)
            _FINGERPRINTS[module] = None if file is None else of_file(file)
        return module

    def attribute(self, module: ModuleType, place: str, name: str) -> Callable[..., Any]:
        """Callable `name` of the module at `place`."""
        found: Any = getattr(module, name, None)
        if callable(found):
            return found  # type: ignore[no-any-return]
        wrong = f"{place} has no {name!r}"
        if hasattr(module, name):
            wrong = f"{name!r} in {place} is {type(found).__name__}, not {self.rule}"
        hint = did_you_mean(name, _functions(module))
        raise OptionError(f"{wrong}; {self._names(module)}{hint}")

    def _execute(self, place: str) -> ModuleType:
        path = os.path.abspath(place)
        name = f"{Path(path).stem}_{hashlib.sha256(path.encode()).hexdigest()[:8]}"
        if name in sys.modules:
            return sys.modules[name]
        if not os.path.isfile(path):
            files = [file.name for file in Path(path).parent.glob("*.py")]
            hint = did_you_mean(os.path.basename(path), files)
            raise OptionError(f"no file {place!r}{hint}; {self.form}")
        spec = spec_from_file_location(name, path)
        assert spec is not None and spec.loader is not None, "a file that ends with .py"
        module = module_from_spec(spec)
        if (folder := os.path.dirname(path)) not in sys.path:
            sys.path.insert(0, folder)
        sys.modules[name] = module  # before it is executed: dataclasses look themselves up
        try:
            spec.loader.exec_module(module)
        except BaseException as error:
            del sys.modules[name]
            raise _unusable(place, error) from None  # the message has its traceback
        return module

    def _import(self, name: str) -> ModuleType:
        if os.getcwd() not in sys.path:
            sys.path.append(os.getcwd())
        try:
            return import_module(name)
        except ModuleNotFoundError as error:
            if error.name is not None and f"{name}.".startswith(f"{error.name}."):
                raise UnknownNameError(f"no module {name!r}; {self.form}") from None
            raise _unusable(name, error) from None
        except BaseException as error:  # scripts end by sys.exit
            raise _unusable(name, error) from None

    def _names(self, module: ModuleType) -> str:
        names = ", ".join(_functions(module))
        return f"its {self.plural}: {names}" if names else f"it has no {self.plural}"


def module_fingerprint(module: ModuleType) -> str | None:
    """That of the file of a module, as it was when `Referent.load` loaded it; None without one."""
    return _FINGERPRINTS[module]


def _unusable(place: str, error: BaseException) -> BaseException:
    """Error for a file that raised one; Ctrl-C stays what it is."""
    if isinstance(error, KeyboardInterrupt):
        return error
    return OptionError(
        f"{place} cannot be imported; mend this error in it:\n{shown_traceback(error)}"
    )


def shown_traceback(error: BaseException, caller: str = __file__) -> str:
    """Traceback of an error, from the user's first line; caller: our file that called the user."""
    own = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename not in (__file__, caller) and "importlib" not in frame.filename
    ]
    shown = traceback.format_list(own) + traceback.format_exception_only(error)
    return "".join(shown).rstrip()


def _functions(module: ModuleType) -> list[str]:
    """Names of the functions that were written in the module."""
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and callable(value)
        and getattr(value, "__module__", None) == module.__name__
    ]


# -- functions of images, tried before anything depends on them ------------------------------------

_RELATIVE, _ABSOLUTE = 1e-3, 1e-5  # kernels of networks round differently for each batch size


def name_of(function: object) -> str:
    """Name of a function, or of the class of another callable."""
    return str(getattr(function, "__name__", type(function).__name__))


def own_name(thing: object) -> str:
    """Name that a thing gives itself, or else that of its function or class."""
    name = getattr(thing, "name", None)
    return name if isinstance(name, str) and name else name_of(thing)


def tried_on(
    target: Float32, function: Callable[[Float32], Any], what: str, error: type[FideError]
) -> tuple[Any, Any]:
    """Values of the target (H, W, 3) and its negative: together, and each alone, (2, ...) each.

    Raises `error` in place of what the function raises, naming it, but for our own errors.
    """
    both = np.stack([target, 1 - target])
    try:
        together = function(both)
        return together, np.concatenate([function(both[:1]), function(both[1:])])
    except FideError:
        raise
    except Exception as cause:
        raise error(
            f"{what} was tried on two images, an array of shape {both.shape} and dtype float32, "
            f"and raised {cause!r}; it gets batches of any number of images"
        ) from cause


def differs(together: Any, alone: Any) -> bool:
    """Whether two arrays (2, ...) differ by more than kernels may round."""
    scale = max(float(np.abs(alone[np.isfinite(alone)]).max(initial=0.0)), _ABSOLUTE)
    return not np.allclose(together, alone, rtol=_RELATIVE, atol=_ABSOLUTE * scale, equal_nan=True)


# -- fingerprints ----------------------------------------------------------------------------------


def of_bytes(kind: str, data: bytes) -> str:
    """Fingerprint of that kind: its name and 16 hexadecimal digits of SHA-256."""
    return f"{kind}:{hashlib.sha256(data).hexdigest()[:16]}"


def of_file(path: str | os.PathLike[str]) -> str | None:
    """Fingerprint of the contents of a file, of the kind "file"; None if it cannot be read."""
    try:
        return of_bytes("file", Path(path).read_bytes())
    except OSError:
        return None


def kind_of(one: str) -> str:
    """Kind of a fingerprint; only those of one kind are compared."""
    return one.partition(":")[0]


def changed(one: str | None, other: str | None) -> bool:
    """Whether two fingerprints are known to be of different things."""
    if one is None or other is None or kind_of(one) != kind_of(other):
        return False
    return one != other


def version_of(render: object) -> str | None:
    """Version that a renderer states by its attribute `version`; None where it states none.

    A method of that name states none, either.  Raises OptionError for anything else than a text.
    """
    version = getattr(render, "version", None)
    if callable(version) or version is None:
        return None
    if not (isinstance(version, str) and version):
        what = f"the version of {own_name(render)}"
        raise OptionError(f"{what} is a text such as '2', or None, not {version!r}")
    return version


def fingerprint_of(render: object) -> str | None:
    """Kind and digest of what a renderer says of itself, or of the source of a function.

    What a file imports, and what a program reads, is not known.  None: nothing is known.
    """
    own = getattr(render, "fingerprint", None)
    if own is None and inspect.isfunction(render):
        try:
            own = of_bytes("function", inspect.getsource(render).encode())
        except (OSError, TypeError, SyntaxError, tokenize.TokenError):
            return None  # the file is gone, or has changed since
    return own if isinstance(own, str) else None
