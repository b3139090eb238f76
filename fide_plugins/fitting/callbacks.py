"""Callbacks: functions of an `Event`, or objects with `on_evaluation(event)` or `on_end(result)`.

They are called in the process and thread of `fit`, so a slow one delays it.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.errors import OptionError
from fide_plugins.fitting.failures import CallbackError
from fide_plugins.recording.record import Progress, Report
from fide_plugins.types import Float64

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE

__all__ = ["Callbacks", "Event", "StopFitting"]

_METHODS = ("on_evaluation", "on_end")


class StopFitting(Exception):
    """Raised by a callback, it stops the fit, which returns its result."""


@dataclass(frozen=True)
class Event:
    """An evaluated image.

    evaluation: its number, from 0.
    x: (dim,), point of the cube.
    loss: of the image; best_loss: lowest so far.
    image: (H, W, 3) float32 in [0, 1], for several views a list of them.  Not to be changed.
    seconds: since the start of the fit, without interruptions.
    busy: renders under way; failures: renders that failed so far.
    optimizer: has `status`, `best`, `solutions`.
    """

    evaluation: int
    x: Float64
    loss: float
    best_loss: float
    image: Any
    seconds: float
    busy: int
    failures: int
    optimizer: FIDE

    @cached_property
    def params(self) -> dict[str, Any] | None:
        """Parameters by name; None without a space."""
        return None if self.optimizer.space is None else self.optimizer.space.decode(self.x)


class Callbacks:
    """Several callbacks as one; given: a callback, or a list or tuple of them.

    `on_evaluation`, or the function, is called after each image was evaluated, and stops the fit if
    it returns True; `on_end` at the end, also after an interruption or an error.

    Raises OptionError (a ValueError) for one that is neither callable nor has any of the methods.
    """

    def __init__(self, given: object) -> None:
        self._methods: dict[str, list[Callable[[Any], object]]] = {name: [] for name in _METHODS}
        for callback in given if isinstance(given, list | tuple) else [given]:
            methods = {name: getattr(callback, name, None) for name in _METHODS}
            found = {name: method for name, method in methods.items() if callable(method)}
            if not found and not callable(callback):
                raise OptionError(
                    f"a callback must be a function or have one of {', '.join(_METHODS)}, "
                    f"not {callback!r}"
                )
            for name, method in (found or {"on_evaluation": callback}).items():
                self._methods[name].append(method)

    def __bool__(self) -> bool:
        return any(self._methods.values())

    def call(self, name: str, argument: object) -> bool:
        """Call method `name` of all with `argument`; whether one stops the fit.  CallbackError."""
        stops = False
        for method in self._methods[name]:
            try:
                answer = method(argument)
                stops |= isinstance(answer, bool | np.bool_) and bool(answer)
            except StopFitting:
                stops = True
            except Exception as error:
                raise CallbackError(f"a callback failed in {name}: {error!r}") from error
        return stops


def check_progress(progress: object) -> None:
    """Raise OptionError (a ValueError) unless it is True, False, None or a function."""
    if not (progress is None or isinstance(progress, bool) or callable(progress)):
        raise OptionError(f"progress must be True, False, None or a function, not {progress!r}")


@contextmanager
def reporting(progress: object) -> Iterator[Report | None]:
    """Context that gives a function which shows progress, as for `fit`; None: nothing is shown."""
    if callable(progress):
        yield progress
    elif progress or (progress is None and sys.stderr is not None and sys.stderr.isatty()):
        try:
            yield _show
        finally:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
    else:
        yield None


def _show(progress: Progress) -> None:
    """Write a line over the one before."""
    best = f"  best {progress.best_loss:.3g}" if math.isfinite(progress.best_loss) else ""
    done = f"{progress.evaluations}/{progress.budget or '-'}  {progress.wall_s:.0f} s"
    print(f"\r{done}{best}  {progress.remark}\x1b[K", end="", file=sys.stderr, flush=True)
