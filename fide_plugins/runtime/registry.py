"""What users name or hand over: factories by name, attributes of files, functions, fingerprints."""

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
        named = isinstance(name, str) and name.isprintable() and name.strip() and ":" not in name
        if not named or not (callable(factory) or str(factory).count(":") == 1):
            raise OptionError(
                f"a {self._kind} needs a printable name without a colon, and a factory, callable "
                f"or 'module:attribute', got {name!r}, {factory!r}"
            )
        self._factories[name] = factory

    def names(self) -> list[str]:
        """Return all names, sorted."""
        return sorted(self._factories)

    def resolve(self, name: str) -> Callable[..., T]:
        """Return the factory called `name`.

        Raises UnknownNameError, and DependencyError for one of a laboratory that is not installed.
        """
        factory = self._factories.get(name) if isinstance(name, str) else None
        if factory is None:
            raise UnknownNameError.of(self._kind, name, [*self._factories, *self._patterns])
        if isinstance(factory, str):
            module, attribute = factory.split(":")
            if module.startswith("fide_lab."):
                from fide_plugins.runtime import laboratory

                laboratory.module()  # raises DependencyError where it is not installed
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
        if colon:
            options = {"variant": variant, **options}
        try:
            inspect.signature(factory).bind(*args, **options)
        except ValueError:  # some functions of C do not say
            pass
        except TypeError as error:
            known = [*inspect.signature(factory).parameters][len(args) :]
            its = ", ".join(known) or "none"
            raise OptionError(f"{self._kind} {name!r}: {error}; its options: {its}") from None
        return factory(*args, **options)


_FINGERPRINTS: WeakKeyDictionary[ModuleType, str | None] = WeakKeyDictionary()


def is_reference(text: str) -> bool:
    """Whether a text has the form of a reference to a function, rather than a name."""
    return ":" in text or text.endswith(".py")


@dataclass(frozen=True, slots=True)
class Referent:
    """What references such as ``FILE.py:NAME`` are to, in words for errors, and how to follow them.

    name: such as "renderer".  rule: what it must be.  form: how to write a reference, with an
    example.  All errors are OptionErrors.
    """

    name: str
    rule: str
    form: str

    def split(self, reference: str) -> tuple[str, str]:
        """File or module, and name."""
        place, _, name = reference.rpartition(":")
        if place and name.isidentifier():
            return place, name
        there = f"; it has {_names(self.load(reference))}" if os.path.isfile(reference) else ""
        raise OptionError(f"no {self.name} {reference!r}; {self.form}{there}")

    def load(self, place: str) -> ModuleType:
        """Module in a file, or by its name; loaded once a process, see `FunctionRenderer`."""
        try:
            module = self._execute(place) if place.endswith(".py") else _import(place)
        except (FideError, KeyboardInterrupt):
            raise
        except BaseException as error:  # scripts end by sys.exit
            name = error.name if isinstance(error, ModuleNotFoundError) else None
            if name is not None and f"{place}.".startswith(f"{name}."):
                raise UnknownNameError(f"no module {place!r}; {self.form}") from None
            shown = shown_traceback(error)
            raise OptionError(
                f"{place} cannot be imported; mend this error in it:\n{shown}"
            ) from None  # the message has its traceback
        if module not in _FINGERPRINTS:  # at once: the file may be edited while this process runs
            file = getattr(module, "__file__", None)
            _FINGERPRINTS[module] = None if file is None else of_file(file)
        return module

    def attribute(self, module: ModuleType, place: str, name: str) -> Callable[..., Any]:
        """Callable `name` of the module at `place`."""
        found: Any = getattr(module, name, None)
        if callable(found):
            return found  # type: ignore[no-any-return]
        raise OptionError(f"{name!r} in {place} must be {self.rule}; it has {_names(module)}")

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
        except BaseException:
            del sys.modules[name]
            raise
        return module


def _import(name: str) -> ModuleType:
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    return import_module(name)


def _names(module: ModuleType) -> str:
    """Names of the functions and classes that were written in the module."""
    return (
        ", ".join(
            name
            for name, value in vars(module).items()
            if not name.startswith("_")
            and callable(value)
            and getattr(value, "__module__", None) == module.__name__
        )
        or "no functions"
    )


def module_fingerprint(module: ModuleType) -> str | None:
    """That of the file of a module, as it was when `Referent.load` loaded it; None without one."""
    return _FINGERPRINTS[module]


def shown_traceback(error: BaseException, caller: str = __file__) -> str:
    """Traceback of an error, from the user's first line; caller: our file that called the user."""
    own = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename not in (__file__, caller) and "importlib" not in frame.filename
    ]
    shown = traceback.format_list(own) + traceback.format_exception_only(error)
    return "".join(shown).rstrip()


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
) -> Any:
    """Values (2, ...) of the target (H, W, 3) and its negative.

    Raises `error` in place of what the function raises, naming it, but for our own errors; and
    where the two have other values together than each alone.
    """
    both = np.stack([target, 1 - target])
    try:
        together = function(both)
        alone = np.concatenate([function(both[:1]), function(both[1:])])
    except FideError:
        raise
    except Exception as cause:
        raise error(
            f"{what} was tried on two images, an array of shape {both.shape} and dtype float32, "
            f"and raised {cause!r}; it gets batches of any number of images"
        ) from cause
    scale = max(float(np.abs(alone[np.isfinite(alone)]).max(initial=0.0)), _ABSOLUTE)
    if not np.allclose(together, alone, _RELATIVE, _ABSOLUTE * scale, equal_nan=True):
        raise error(
            f"{what} must give an image the same values in every batch, but two images together "
            "have others than each alone; average and normalize over each image, and switch layers "
            "that depend on the batch off (model.eval())"
        )
    return together


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
