"""The number of samples per pixel: as few as keep noise from deciding the ranks of candidates.

A search needs only the ranks of the candidates of a generation.  Noise decides them if

    sigma > tolerance * spread,

where sigma is the standard deviation of one candidate's loss between two renders, and spread that
of the losses of candidates that were told together, a generation or a part of it.  While the
population is wide, its losses differ much, and few samples are enough.  As it narrows, noise begins
to dominate, and the number of samples is multiplied.  Hansen et al. 2009, "A method for handling
uncertainty in evolutionary optimization", evaluate candidates again and adapt by rank changes; here
a few candidates are rendered twice to estimate sigma.

The number never decreases.  Noise increases most losses of images, such as the mean squared error.
So a loss at few samples is too high rather than too low, and stays comparable after an increase.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fide_lab.run.task import TaskInfo
from fide_plugins.errors import OptionError
from fide_plugins.losses.base import as_losses
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.points import whole_number

if TYPE_CHECKING:
    from fide_plugins.recording.record import Record


_PAIRS, _FEWEST_PAIRS = 16, 8  # pairs of renders of one candidate that estimate sigma
_SPREADS, _FEWEST_SPREADS = 8, 3  # notes of losses whose median spread counts
_FACTOR = 4
_SMALLEST = 4  # fewest candidates that give a spread
_NORMAL = 1.349  # interquartile range of the normal distribution, in standard deviations


class PixelSamples:
    """The number of samples per pixel, from `least` to `most`.

    tolerance: largest ratio of noise to spread.
    every: one of this many candidates is rendered twice.

        samples = PixelSamples(1, 64)
        while opt.evaluations < 5000:
            X = opt.ask()
            losses = mse(render(X, samples.number))
            again = mse(render(X[:1], samples.number))[0] if samples.pair_due else None
            samples.note(losses, again)

    The two renders of a candidate must have independent noise.  Raises OptionError (a ValueError).
    """

    def __init__(
        self, least: int = 1, most: int = 64, *, tolerance: float = 0.5, every: int = 18
    ) -> None:
        self.least, self.most = whole_number("least", least, 1), whole_number("most", most, 1)
        if self.least > self.most:
            raise OptionError(f"least must not be above most, got {least} and {most}")
        if not 0 < tolerance < float("inf"):
            raise OptionError(f"tolerance must be positive and finite, not {tolerance!r}")
        self.tolerance, self.every = float(tolerance), whole_number("every", every, 1)
        self.number = self.least
        """Samples per pixel for the next candidates."""
        self._since = 0  # candidates since the last pair
        self._halves: deque[float] = deque(maxlen=_PAIRS)  # half the squared difference of a pair
        self._spreads: deque[float] = deque(maxlen=_SPREADS)

    @property
    def pair_due(self) -> bool:
        """Whether one of the next candidates must be rendered twice."""
        return self.number < self.most and self._since >= self.every

    @property
    def noise(self) -> float | None:
        """Estimate of sigma at the current number; None while there are too few pairs."""
        few = len(self._halves) < _FEWEST_PAIRS
        return None if few else float(np.sqrt(np.mean(self._halves)))

    @property
    def spread(self) -> float | None:
        """Median spread of the losses last noted at the current number; None before three notes."""
        few = len(self._spreads) < _FEWEST_SPREADS
        return None if few else float(np.median(self._spreads))

    def note(
        self, losses: npt.ArrayLike, again: float | None = None, *, more: bool = False
    ) -> bool:
        """Record losses (n,) of candidates that were rendered together, with `number` samples.

        They are a generation, or a part of a large one, of which each part gives a spread.

        again: loss of a second render of the first candidate, if there was one.
        more: whether others follow that were asked with them, and so need the same number.

        Returns whether `number` has risen; then the best candidate should be rendered again.
        Raises LossError (a ValueError).
        """
        values = as_losses(losses, np.size(losses))  # (n,)
        second = None if again is None else as_losses([again], 1)
        if second is not None and len(values):
            self._note_pair(values[0], second[0])
        self._since += len(values)
        finite = values[np.isfinite(values)]
        if len(finite) >= _SMALLEST:
            self._spreads.append(_spread(finite))
        if more or not self._noise_decides():
            return False
        before, self.number = self.number, min(self.most, _FACTOR * self.number)
        for i in range(len(self._halves)):  # as for independent samples, until new pairs come
            self._halves[i] *= before / self.number
        self._spreads.clear()
        return True

    def _note_pair(self, first: float, second: float) -> None:
        self._since = 0
        if np.isfinite(first) and np.isfinite(second):
            self._halves.append((first - second) ** 2 / 2)

    def _noise_decides(self) -> bool:
        if self.number == self.most or self.noise is None or self.spread is None:
            return False
        return self.noise > self.tolerance * self.spread

    def state_dict(self) -> dict[str, Any]:
        """The evolving state."""
        return {
            "number": self.number,
            "since": self._since,
            "halves": np.array(self._halves, np.float64),
            "spreads": np.array(self._spreads, np.float64),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the state that `state_dict` returned."""
        self.number, self._since = int(state["number"]), int(state["since"])
        self._halves = deque(np.asarray(state["halves"]).tolist(), _PAIRS)
        self._spreads = deque(np.asarray(state["spreads"]).tolist(), _SPREADS)


def _spread(losses: Float64) -> float:
    """Standard deviation estimated from quartiles, robust against a few very bad candidates."""
    low, high = np.quantile(losses, [0.25, 0.75])
    return float(high - low) / _NORMAL


class Fidelity:
    """Renders candidates with the number of samples that `PixelSamples` chooses.

    task: has an attribute `spp`, the largest number of samples, which its `render` uses.
    least: initial number of samples per pixel.

    Raises OptionError (a ValueError) for a task without `spp`, or with fewer than `least`.
    """

    def __init__(self, task: Any, least: int) -> None:
        info = TaskInfo.of(task)
        if not isinstance(info.spp, int):
            raise OptionError(
                f"least_spp is for tasks that take samples of a pixel (spp), and {info.name} takes "
                "none: leave it out"
            )
        self.rule = PixelSamples(least, info.spp)
        self._task = task
        self._level = 0  # samples of the best candidate's render
        self.total = 0
        """Sum of the samples per pixel of all renders so far."""

    def render(self, X: Float64, seed: Sequence[int]) -> Any:
        """Images of candidates (n, dim)."""
        self._task.spp = self.rule.number
        try:
            return self._task.render(X, seed=seed)
        finally:
            self._task.spp = self.rule.most

    def extra_points(self, X: Float64, record: Record) -> Float64:
        """Points (m, dim) to render in addition to X: the best candidate, the first of X."""
        best = [] if record.x_best is None or not self._has_risen else [record.x_best]
        return np.array([*best, *X[: int(self.rule.pair_due)]]).reshape(-1, X.shape[1])

    def note(
        self, record: Record, losses: Float64, images: Float32, others: Float64, more: bool = False
    ) -> None:
        """Record losses of candidates (n,), and images and losses (m,) of the `extra_points`.

        To be called before the record gets the candidates.
        more: whether others follow that were asked with them.  An optimizer that hands out the two
            parts of a generation one after the other (`FIDE.ask_ready`) may have a number for each.
        """
        self.total += self.rule.number * (len(losses) + len(others))
        if self._has_risen and record.x_best is not None:
            record.judge_again(images[0], float(others[0]))
            others = others[1:]
        self._level = self.rule.number
        self.rule.note(losses, float(others[0]) if len(others) else None, more=more)

    @property
    def _has_risen(self) -> bool:
        return self._level < self.rule.number

    def state_dict(self) -> dict[str, Any]:
        """The evolving state; `recording.record` says what it must look like."""
        return {"rule": self.rule.state_dict(), "level": self._level, "total": self.total}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the state that `state_dict` returned."""
        self.rule.load_state_dict(state["rule"])
        self._level, self.total = int(state["level"]), int(state["total"])
