"""Every optimizer by name: FIDE, its rivals, and what others register.

    >>> from fide_lab import optimizers
    >>> optimizers.names()[:4]
    ['cma', 'dfols', 'dibo', 'diffusion-evolution']
    >>> opt = optimizers.make("cma", 3, popsize=8, seed=0)
    >>> opt.ask().shape
    (8, 3)

``"nevergrad:NAME"`` and ``"optuna:NAME"`` are any optimizer of these frameworks, by the name that
it has there; ``"FILE.py:NAME"`` and ``"module:NAME"`` one of the user's, see `baselines.own`.  In
place of a name there may be a class or a function that makes an optimizer.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, TypeAlias

from fide_lab.baselines import FAMILIES, PLACES as BASELINES
from fide_plugins.errors import OptionError
from fide_plugins.runtime.registry import Registry, is_reference, own_name
from fide_plugins.types import Optimizer

if TYPE_CHECKING:
    from fide_plugins.space import Space

__all__ = ["check", "load", "make", "names", "options", "register", "source_of"]

PLACES: Mapping[str, str] = {"fide": "fide_plugins.fide:FIDE", **BASELINES}
"""Where the classes of ours are."""
_REGISTRY: Registry[Any] = Registry("optimizer", [f"{family}:NAME" for family in FAMILIES])
for _name, _place in PLACES.items():
    _REGISTRY.register(_name, _place)

Named: TypeAlias = str | Callable[..., Any]
"""Name of an optimizer, its class, or a function that makes one."""


def names() -> list[str]:
    """Names of all optimizers, sorted; those of the frameworks are not among them."""
    return _REGISTRY.names()


def register(name: str, cls: Callable[..., Optimizer] | str) -> None:
    """Make the class `cls`, or the one at ``"module:attribute"``, known by `name`.

    A class that has only `ask` and `tell` is wrapped by `baselines.own`.  A class with a true
    attribute `takes_space` gets the `Space`, where there is one; others its number of parameters.

    Raises OptionError (a ValueError) for a name with a colon, or a wrong `cls`.
    """
    _REGISTRY.register(name, cls)


def check(name: Named, settings: Iterable[str]) -> None:
    """Check a name and those of `settings`, without making an optimizer.

    Raises UnknownNameError, or OptionError listing the options there are (both ValueErrors).
    """
    known = options(name)
    unknown = sorted(set(settings) - set(known)) if known else []
    if unknown:
        listed = ", ".join(known)
        raise OptionError(f"{name} has no option {unknown[0]!r}; its options: {listed}")


def make(name: Named, dim: int | Space, target: object = None, **settings: Any) -> Optimizer:
    """Optimizer `name` over [0, 1]^dim for `target`, with its own `settings`.

    dim: number of parameters; or a space, of which most optimizers see the number only.

    Raises UnknownNameError, or OptionError listing the options there are (both ValueErrors).
    """
    check(name, settings)
    cls = _resolve(name)
    takes_space = getattr(cls, "takes_space", False)
    space = dim if takes_space else getattr(dim, "dim", dim)
    optimizer: Optimizer = cls(space, target, **settings)
    if not isinstance(optimizer, Optimizer):
        raise OptionError(
            f"{own_name(cls)} makes {own_name(optimizer)}, which is no whole optimizer; give its "
            "class, not a function that makes it"
        )
    return optimizer


def load(
    name: str, path: str | os.PathLike[str], *, device: str | None = None, loss: object = None
) -> Optimizer:
    """Optimizer `name` as it was saved at `path`.

    device: on which it goes on, if its `load` has that option; None: as its class chooses.
    loss: a user's own, which a checkpoint cannot hold; None: it holds its name.
    """
    cls = _resolve(name)
    takes_device = "device" in inspect.signature(cls.load).parameters
    chosen: dict[str, Any] = {"device": device} if takes_device and device is not None else {}
    if loss is not None:
        chosen["loss"] = loss
    loaded: Optimizer = cls.load(path, **chosen)
    return loaded


def options(name: Named) -> list[str]:
    """Names of the options of optimizer `name`; empty where it takes any."""
    resolved = _resolve(name)
    known = set(getattr(resolved, "more_options", ()))
    if hasattr(resolved, "option_names"):
        return list(resolved.option_names())
    classes: tuple[Any, ...] = inspect.getmro(resolved) if inspect.isclass(resolved) else ()
    for maker in [cls.__init__ for cls in classes] or [resolved]:
        # an __init__ with **options hands them to the next class
        parameters = inspect.signature(maker).parameters.values()
        known.update(p.name for p in parameters if p.kind is p.KEYWORD_ONLY)
        if all(p.kind is not p.VAR_KEYWORD for p in parameters):
            return sorted(known)
    return []


def source_of(name: Named) -> str | None:
    """Fingerprint of the file of the user's class `name`; None for any other optimizer."""
    found = getattr(_resolve(name), "source", None)
    return found if isinstance(found, str) else None


def _resolve(name: Named) -> Any:
    """Class of that name, or function that makes such an optimizer."""
    from fide_lab.baselines.own import own

    if isinstance(name, str) and name not in names():
        family, _, method = name.partition(":")
        if family in FAMILIES and method:
            return _of_family(family, method)
        if family not in FAMILIES and is_reference(name):
            return own(name)
    found = name if callable(name) else _REGISTRY.resolve(name)
    whole = all(hasattr(found, part) for part in _METHODS)
    return own(found) if isinstance(found, type) and not whole else found


_METHODS = ("ask", "ask_ready", "tell", "recommend", "save", "load")
"""Of `types.Optimizer`."""


@cache
def _of_family(family: str, method: str) -> Any:
    """Class of the optimizer `method` of a framework; always the same one."""
    from fide_lab.baselines import libraries

    return getattr(libraries, family)(method)
