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

import numpy as np

from fide_plugins.errors import FideError, RenderError
from fide_plugins.fitting.rendering import Failed
from fide_plugins.runtime.messages import warn_user

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE
    from fide_plugins.fitting.result import Result
    from fide_plugins.types import Float32
    from fide_plugins.views import Views


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


_BETTER = 0.25  # of the squared error, from which on a change of all values explains it
_LARGE = 50.0  # factor that no choice of parameters has brought about
_NARROW = 0.02  # of the target's range, of which renders show something


class Extremes:
    """Range of the values of all renders, as far as it is narrow: then nothing more is measured.

    views: of the target; there is nothing to measure without a range of values.
    """

    def __init__(self, views: Views) -> None:
        self._views = views
        self._low, self._high = np.inf, -np.inf
        low, high = self._of(views.target)
        self._span = high - low
        self.wanted = views.values is not None and self._span > 0
        """Whether further renders are to be measured."""

    def note(self, image: Float32) -> None:
        """Count a packed image in [0, 1], if it is wanted."""
        if not self.wanted:
            return
        low, high = self._of(image)
        self._low, self._high = min(self._low, low), max(self._high, high)
        self.wanted = self._high - self._low < _NARROW * self._span

    def suspicion(self) -> str | None:
        """What is wrong if the renders are narrow."""
        values = self._views.values
        if not self.wanted or values is None or self._low > self._high:
            return None
        ends = [values.low + end * values.span for end in (self._low, self._high)]
        return (
            f"all renders have values in [{ends[0]:.4g}, {ends[1]:.4g}], less than {_NARROW:.0%} "
            f"of the range of the target, {self._span * values.span:.4g}: are they on its scale? "
            "With value_range all types are numbers as they are; where floats in [0, 1] meet a "
            "target of uint8, return 255 * image"
        )

    def _of(self, image: Float32) -> tuple[float, float]:
        low, high = np.inf, -np.inf
        for view, part in zip(self._views.views, self._views.split(image[None]), strict=True):
            seen = part[0] if view.hidden is None else part[0][~view.hidden]
            low, high = min(low, float(seen.min())), max(high, float(seen.max()))
        return low, high


def suspicion_of(optimizer: FIDE, extremes: Extremes) -> str | None:
    """Sentence that says what seems wrong with all renders; None: nothing.

    extremes: of these.
    Compared are mean squared errors of the best image, whatever the loss is.
    """
    best = optimizer.state.best
    image = None if best is None else best.solution.image
    if image is None or optimizer.status.code in ("solved", "noise"):
        return None
    if narrow := extremes.suspicion():
        return narrow
    views, error = optimizer.views, optimizer.views.squared_error(image)
    swapped = views.squared_error(np.ascontiguousarray(image[..., ::-1]))
    if swapped < _BETTER * error:
        return (
            f"the best image fits much better with red and blue swapped (mean squared error "
            f"{swapped:.3g} in place of {error:.3g}): if the renderer gives BGR, as OpenCV does, "
            "return image[..., ::-1]"
        )
    factor = _factor(image, views.target)
    scaled = views.squared_error(np.clip(np.float32(factor) * image, 0.0, 1.0))
    if factor > _LARGE and scaled < _BETTER * error:
        return (
            f"the best image fits much better if it is {factor:.3g} times as bright (mean squared "
            f"error {scaled:.3g} in place of {error:.3g}): are the renders on the target's scale? "
            "uint8 is in [0, 255], floats are in [0, 1]; masks of 0 and 1 are bool"
        )
    return None


def _factor(image: Float32, target: Float32) -> float:
    """Factor by which an image is nearest to the target."""
    one, other = image.astype(np.float64).ravel(), target.astype(np.float64).ravel()
    square = float(one @ one)
    return float(one @ other) / square if square > 0 else 0.0
