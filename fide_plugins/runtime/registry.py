"""Factories by name, for encoders, losses and optimizers, also those of plug-ins."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Generic, TypeVar

from fide_plugins.errors import OptionError, UnknownNameError

__all__ = ["Registry"]

T = TypeVar("T")


class Registry(Generic[T]):
    """Factories by name.

    A factory is a callable, or the string ``"package.module:attribute"`` of one, which is imported
    when the name is first used: listing names imports nothing.  A factory with an option `variant`
    also accepts ``"name:variant"``.

    kind: what they make, for errors.  patterns: names that somebody else understands, for errors.

    >>> shapes = Registry[str]("shape")
    >>> shapes.register("line", lambda n: "-" * n)
    >>> shapes.names()
    ['line']
    >>> shapes.make("line", 3)
    '---'
    """

    def __init__(self, kind: str, patterns: Sequence[str] = ()) -> None:
        self._kind, self._patterns = kind, patterns
        self._factories: dict[str, Callable[..., T] | str] = {}

    def register(self, name: str, factory: Callable[..., T] | str) -> None:
        """Add `factory` under `name`, or replace the factory of that name."""
        sound = isinstance(name, str) and name.isprintable() and name.strip() and ":" not in name
        if not sound:
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
            raise self._unknown(name)
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
        if not isinstance(name, str):
            raise self._unknown(name)
        name, colon, variant = name.partition(":")
        factory = self.resolve(name)
        self._check(name, factory, len(args), options)
        if not colon:
            return factory(*args, **options)
        if not self.takes(name, "variant"):
            raise OptionError(f"the {self._kind} {name!r} has no variants, got {name}:{variant}")
        return factory(*args, variant=variant, **options)

    def _unknown(self, name: object) -> UnknownNameError:
        return UnknownNameError.of(self._kind, name, [*self._factories, *self._patterns])

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
        unknown = sorted(options.keys() - set(known))
        if unknown:
            raise OptionError(
                f"the {self._kind} {name!r} has no option {unknown[0]!r}; it has: "
                f"{', '.join(known) or 'none'}"
            )
