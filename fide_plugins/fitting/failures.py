"""Renders that gave no image: counted, the first one shown whole, and when to give up."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.errors import FideError, RenderError
from fide_plugins.fitting.rendering import Failed
from fide_plugins.runtime.messages import warn_user

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE
    from fide_plugins.fitting.result import Result


_FIRST = 8  # renders after which errors are looked at, and other places tried
_FIRST_EVERYWHERE = 200  # renders which must not all fail
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


@dataclass
class Failures:
    """Failures of a fit, with those of earlier calls; first: of this call.

    It gives up where the first 8 all failed by errors which other parameters hardly mend; where
    none of the first 200 gave an image; where as many failed in a row as is very unlikely after
    what succeeded before; where more of the last 50 failed than `max_failures`, in (0, 1], allows.
    """

    count: int = 0
    max_failures: float = 1.0
    first: Failed | None = None
    _done: int = 0
    _images: int = 0
    _in_a_row: int = 0  # failed since the last image
    _all_broken: bool = True
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
            self.first = replace(failed, params=params)
            message = f"a render failed, its candidate is withdrawn: {self.first}"
            warn_user(message, RenderFailedWarning)

    def check(self) -> None:
        """Raise GivenUpError if hardly any render succeeds."""
        rule, failed = "", sum(self._latest)
        until_success = (self._done - self._in_a_row) / max(self._images, 1)
        if not self._images:
            if self._done >= (_FIRST if self._all_broken else _FIRST_EVERYWHERE):
                rule = f"the first {self._done} renders all failed"
                rule += "" if self._all_broken else f", all over the space{_REMEDY}"
        elif len(self._latest) == _WINDOW and failed > self.max_failures * _WINDOW:
            rule = f"{failed} of the last {_WINDOW} renders failed, more than max_failures="
            rule += f"{self.max_failures:g}"
        elif self._in_a_row >= max(_WINDOW, _IN_A_ROW * until_success):
            rule = f"the last {self._in_a_row} renders all failed"
        if rule and self.first is not None:
            raise GivenUpError(
                f"given up: {rule}; {self.count} failed so far, the first one, which a warning has "
                f"shown whole: {self.first.brief}"
            )

    @property
    def tried(self) -> bool:
        """Whether enough renders have failed, and none succeeded, to try other places."""
        return not self._images and self._done >= _FIRST


_BETTER = 0.25  # of the squared error, from which on a change of all values explains it
_LARGE = 50.0  # factor that no choice of parameters has brought about


def suspicion_of(optimizer: FIDE) -> str | None:
    """What seems wrong with all renders, by squared errors of the best image; None: nothing."""
    best = optimizer.state.best
    image = None if best is None else best.solution.image
    if image is None or optimizer.status.code in ("solved", "noise"):
        return None
    views, error = optimizer.views, optimizer.views.squared_error(image)
    one, other = image.astype(np.float64).ravel(), views.target.astype(np.float64).ravel()
    factor = float(one @ other) / max(float(one @ one), 1e-300)
    swapped = views.squared_error(np.ascontiguousarray(image[..., ::-1]))
    scaled = views.squared_error(np.clip(np.float32(factor) * image, 0.0, 1.0))
    what, remedy, left = f"{factor:.3g} times as bright", _SCALE, scaled
    if swapped < _BETTER * error:
        what, remedy, left = "with red and blue swapped", "return image[..., ::-1]", swapped
    elif factor <= _LARGE or scaled >= _BETTER * error:
        return None
    return (
        f"the best image fits much better {what} (mean squared error {left:.3g} in place of "
        f"{error:.3g}): {remedy}"
    )


_SCALE = (
    "are the renders on the target's scale? uint8 is in [0, 255], floats are in [0, 1], masks of 0 "
    "and 1 are bool; with value_range all numbers are as they are, so return 255 * image for bytes"
)
