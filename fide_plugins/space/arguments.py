"""Arguments of a kind of parameter: wrong ones are a SpaceError that has the right word."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from inspect import Parameter, signature
from typing import Any, TypeVar

from fide_plugins.errors import SpaceError
from fide_plugins.space.synonyms import right_word

__all__ = ["explained"]

T = TypeVar("T")


def explained(usage: str) -> Callable[[type[T]], type[T]]:
    """Decorator of a class whose constructor says which argument is wrong, and what is right.

    usage: how the class is used, such as "Float(0, 1)".
    """

    def decorate(cls: type[T]) -> type[T]:
        init: Any = vars(cls)["__init__"]
        _, *parameters = signature(init).parameters.values()

        @wraps(init)
        def checked(self: T, *args: Any, **kwargs: Any) -> None:
            _check(cls.__name__, parameters, args, kwargs, usage)
            init(self, *args, **kwargs)

        setattr(cls, "__init__", checked)  # noqa: B010  # of a class that may be anything
        return cls

    return decorate


def _check(
    kind: str,
    parameters: list[Parameter],
    args: tuple[Any, ...],
    kwargs: dict[str, Any],
    usage: str,
) -> None:
    positional = [p for p in parameters if p.kind is Parameter.POSITIONAL_OR_KEYWORD]
    any_number = any(p.kind is Parameter.VAR_POSITIONAL for p in parameters)
    names = [p.name for p in parameters if p.kind is not Parameter.VAR_POSITIONAL]
    for name in kwargs:
        if name not in names:
            takes = f"it takes {', '.join(names)}" if names else f"write {usage}"
            raise SpaceError(f"{kind} has no argument {name!r}; {takes}{right_word(name, names)}")
    if len(args) > len(positional) and not any_number:
        raise SpaceError(
            f"{kind} takes {' and '.join(p.name for p in positional)} by position and all else by "
            f"name, not {len(args)} values; write {usage}"
        )
    for p in positional[: len(args)]:
        if p.name in kwargs:
            raise SpaceError(f"{kind} has {p.name} by position and by name; write {usage}")
    given = {p.name for p in positional[: len(args)]} | kwargs.keys()
    for p in positional:
        if p.default is Parameter.empty and p.name not in given:
            raise SpaceError(f"{kind} needs {p.name}; write {usage}")
