"""Renders that gave no image: counted, the first one shown whole, and when to give up.

Many parameters may be invalid: of CAD models often most are, and only the renderer knows it.  So a
fit goes on as long as renders succeed now and then.  It gives up where

- the first 8 all failed by errors which other parameters hardly mend (`Failed.broken`),
- none of the first 200 gave an image, of which the later ones are all over the space; or none
  of the first 40, where these took ten minutes,
- as many failed in a row as is very unlikely after what succeeded before: 50, or 15 times the
  number that one success has taken,
- more of the last 50 failed than the user allows.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from fide_plugins.errors import FideError, RenderError
from fide_plugins.fitting.rendering import Failed
from fide_plugins.runtime.messages import warn_user

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

_FIRST = 8  # renders after which errors are looked at, and other places tried
_FIRST_EVERYWHERE = 200  # renders which must not all fail
_FIRST_SLOW, _SLOW = 40, 600.0  # renders, after so many seconds, which must not all fail
_WINDOW = 50  # latest renders that are looked at
_REMEDY = (
    "; if most parameters are invalid, say which are valid, by constraints=function of the "
    "parameters, or [constraints] in the file of the space"
)
_IN_A_ROW = 15  # times as many as one success has taken; of these exp(-15) fail by chance


class FitError(FideError, RuntimeError):
    """A fit that could not go on.

    result: what was computed until then, a `Result`.
    """

    result: Result


class GivenUpError(FitError, RenderError):
    """Hardly any render succeeds."""


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
    max_failures: share of the latest renders that may fail, in (0, 1].
    first: of this call.
    """

    count: int = 0
    max_failures: float = 1.0
    first: Failure | None = None
    _done: int = 0
    _images: int = 0
    _in_a_row: int = 0  # failed since the last image
    _all_broken: bool = True
    _began: float = field(default_factory=time.monotonic)
    _latest: deque[bool] = field(default_factory=lambda: deque(maxlen=_WINDOW))  # failed?

    def note_image(self) -> None:
        """Note a render that gave an image."""
        self._done += 1
        self._images += 1
        self._in_a_row = 0
        self._latest.append(False)

    def note(self, failed: Failed, params: Any) -> None:
        """Note a render that gave none; warns of the first one."""
        self.count += 1
        self._done += 1
        self._in_a_row += 1
        self._all_broken &= failed.broken
        self._latest.append(True)
        if self.first is None:
            self.first = Failure(params, failed.reason, failed.details, failed.names_params)
            message = f"a render failed, its candidate is withdrawn: {self.first}"
            warn_user(message, RenderFailedWarning)

    def check(self) -> None:
        """Raise GivenUpError if hardly any render succeeds."""
        rule = self._rule()
        if rule and self.first is not None:
            raise GivenUpError(
                f"given up: {rule}; {self.count} failed so far, the first one, which a warning has "
                f"shown whole: {self.first.brief}"
            )

    @property
    def tried(self) -> bool:
        """Whether enough renders have failed, and none succeeded, to try other places."""
        return not self._images and self._done >= _FIRST

    def _rule(self) -> str:
        """Why to give up; empty: there is no reason."""
        if not self._images:
            if self._done >= _FIRST and self._all_broken:
                return f"the first {self._done} renders all failed"
            slow = time.monotonic() - self._began > _SLOW
            if self._done >= (_FIRST_SLOW if slow else _FIRST_EVERYWHERE):
                return f"the first {self._done} renders all failed, all over the space{_REMEDY}"
            return ""
        failed, allowed = sum(self._latest), self.max_failures
        if len(self._latest) == _WINDOW and failed > allowed * _WINDOW:
            return (
                f"{failed} of the last {_WINDOW} renders failed, more than max_failures={allowed:g}"
            )
        until_success = (self._done - self._in_a_row) / self._images
        if self._in_a_row >= max(_WINDOW, _IN_A_ROW * until_success):
            return f"the last {self._in_a_row} renders all failed"
        return ""
