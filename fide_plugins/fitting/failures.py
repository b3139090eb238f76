"""Renders that gave no image: counted, the first one shown whole, and when to give up."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from fide_plugins.errors import FideError, RenderError
from fide_plugins.fitting.rendering import Failed
from fide_plugins.runtime.warn import warn_user

if TYPE_CHECKING:
    from fide_plugins.fitting.result import Result

__all__ = [
    "CallbackError",
    "EvaluationError",
    "Failure",
    "Failures",
    "FitError",
    "GivenUpError",
    "RenderFailedWarning",
]

_FIRST = 8  # renders which must not all fail
_WINDOW = 50  # latest renders of which no more than half may fail


class FitError(FideError, RuntimeError):
    """A fit that could not go on.

    result: what was computed until then, a `Result`.
    """

    result: Result


class GivenUpError(FitError, RenderError):
    """Most renders fail."""


class CallbackError(FitError):
    """A callback raised an exception."""


class EvaluationError(FitError):
    """The loss or the encoder raised an exception."""


class RenderFailedWarning(RuntimeWarning):
    """A render gave no image; issued once for each fit."""


@dataclass(frozen=True, slots=True)
class Failure:
    """A render that gave no image.

    params: argument of the user's function.
    reason: in one line; details: the traceback, or what else is known.
    names_params: whether they say with which parameters.
    """

    params: Any
    reason: str
    details: str = ""
    names_params: bool = False

    def __str__(self) -> str:
        return "\n".join(filter(None, [self.reason, self._call, self.details]))

    @property
    def brief(self) -> str:
        """The same without a traceback or a program's output, but for its last line."""
        end = self.details.rpartition("\n")[2].strip()
        told = not end or end in self.reason
        return "\n".join(
            filter(None, [self.reason if told else f"{self.reason}: {end}", self._call])
        )

    @property
    def _call(self) -> str:
        return "" if self.names_params else f"render({self.params})"


@dataclass
class Failures:
    """Failures of a fit.

    count: so far; earlier calls that were resumed included.
    first: of this call.
    """

    count: int = 0
    first: Failure | None = None
    _done: int = 0
    _latest: deque[bool] = field(default_factory=lambda: deque(maxlen=_WINDOW))  # failed?

    def note_image(self) -> None:
        """Note a render that gave an image."""
        self._done += 1
        self._latest.append(False)

    def note(self, failed: Failed, params: Any) -> None:
        """Note a render that gave none; warns of the first one."""
        self.count += 1
        self._done += 1
        self._latest.append(True)
        if self.first is None:
            self.first = Failure(params, failed.reason, failed.details, failed.names_params)
            message = f"a render failed, its candidate is withdrawn: {self.first}"
            warn_user(message, RenderFailedWarning)

    def check(self) -> None:
        """Raise GivenUpError if most renders fail."""
        rule = self._rule()
        if rule and self.first is not None:
            raise GivenUpError(
                f"given up: {rule}; {self.count} failed so far, the first one, which a warning has "
                f"shown whole: {self.first.brief}"
            )

    def _rule(self) -> str:
        """Why to give up; empty: there is no reason."""
        failed = sum(self._latest)
        if self._done == failed == _FIRST:
            return f"the first {_FIRST} renders all failed"
        if len(self._latest) == _WINDOW and failed > _WINDOW // 2:
            return f"{failed} of the last {_WINDOW} renders failed, more than half"
        return ""
