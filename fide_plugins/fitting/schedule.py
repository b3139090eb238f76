"""What a fit asks its renderer for next: samples and size of pictures, and when both rise.

Samples rise where noise decides ranks, sizes where the search sees no more at the present one.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from fide_plugins.adapt_comparison import compare_finer, compare_first_at
from fide_plugins.errors import ImageError
from fide_plugins.fitting.pictures import as_told
from fide_plugins.fitting.rendering import Failed, Outcome, Rendered, Workers
from fide_plugins.fitting.workers import gathered
from fide_plugins.runtime.messages import duration, warn_user
from fide_plugins.types import Float64
from fide_plugins.validation.values import Clipping

if TYPE_CHECKING:
    from fide_plugins.fide import FIDE

_RISE = 4  # times as many samples, or pixels
_PAIRS, _FEWEST_PAIRS, _EVERY = 16, 8, 18  # renders of one candidate twice: kept, needed, one of
_SOONER = 20  # parts of a budget: a pair for each of them, where that is more often
_SPREADS, _FEWEST_SPREADS = 8, 3  # generations whose median spread of losses counts
_TOLERANCE = 0.5  # largest ratio of noise to spread
_NORMAL = 1.349  # interquartile range of the normal distribution, in standard deviations
SHARE = 0.4  # of budget or time, after which pictures have their full size
_GOOD = 0.1  # of the first candidates' median loss
_NARROW = 1 / 3  # of a pixel: the mean standard deviation of a search that sees no more
_STALE, _GAIN = 8, 0.1  # generations in which the loss does not improve by that share
_WIDER = 2.0  # times the search's spread, with which it begins at another size


class Schedule:
    """Size and samples of the next renders of a fit.

    takes: keyword arguments of the renderer.
    sizes: (h, w) of renders, from the smallest; of views of several sizes one list of theirs.
    samples: of a pixel, the fewest and the most.
    """

    def __init__(
        self, takes: list[str], sizes: list[Any], samples: tuple[int, int], optimizer: FIDE
    ) -> None:
        self._optimizer, self._takes, self._seed = optimizer, takes, optimizer.seed
        self.sizes, (least, self._most) = sizes, samples
        self._full = optimizer.views.views[0].size
        self.k, self.samples = 0, least
        """Which size, and how many samples of a pixel."""
        self.cost = 0.0
        """Of all renders so far, in full ones, by pixels times samples."""
        self._count, self._since, self._told, self._every = 0, 0, 0, _EVERY
        self._best, self._best_at = math.inf, 0
        self._typical: float | None = None  # median loss of the first generation
        self._spread: Float64 | None = None  # (d,), of the search when it found the best
        self._rising: tuple[Float64, Float64] | None = None  # where it goes on: x and std, (d,)
        self._works = [len(self.sizes) - 1]  # sizes that have given an image, and the last
        self._refused: str | None = None  # where and why a render failed, and larger ones are tried
        self._halves: deque[float] = deque(maxlen=_PAIRS)  # half the squared difference of a pair
        self._spreads: deque[float] = deque(maxlen=_SPREADS)
        self._losses: list[float] = []
        self._last_told = np.empty(0)
        self._again: tuple[Float64, float] | None = None  # to be rendered twice, and its loss
        self._next: tuple[int, int] | None = None

    @property
    def options(self) -> dict[str, Any]:
        """What defines it, for a file."""
        return {"size": [list(one) for one in self.sizes], "samples": self._most}

    @property
    def _last(self) -> int:
        return len(self.sizes) - 1

    @property
    def is_finest(self) -> bool:
        """Whether no render can be finer."""
        return (self.k, self.samples) == (self._last, self._most)

    @property
    def _may_rise(self) -> bool:
        return not self.is_finest and self._next is None and self._rising is None

    def finest(self) -> dict[str, Any]:
        """Keyword arguments of the finest render."""
        return self.keywords(self._last, self._most, 0)

    def request(self) -> dict[str, Any]:
        """Keyword arguments of the next render."""
        self._count += 1
        seed = np.random.default_rng((self._seed, 5, self._count)).integers(2**31)
        return self.keywords(self.k, self.samples, int(seed))

    def keywords(self, k: int, samples: int, seed: int) -> dict[str, Any]:
        """Of a render of the k-th size."""
        given = {"size": self.sizes[k], "samples": samples, "seed": seed}
        return {name: given[name] for name in self._takes}

    def keep(self, kept: list[int]) -> None:
        """Ask for these sizes only, the last among them; before anything was told."""
        self.sizes = [self.sizes[k] for k in kept]
        self._works = [len(kept) - 1]
        self.begin()

    def pay(self, k: int, samples: int) -> None:
        """Count a render."""
        pixels = 1.0 if k == self._last else math.prod(self.sizes[k]) / math.prod(self.sizes[-1])
        self.cost += pixels * samples / self._most

    def _shown(self, k: int) -> tuple[int, int] | None:
        """Size at which the optimizer compares; None: the target's."""
        return None if len(self.sizes) == 1 or self.sizes[k] == self._full else self.sizes[k]

    def begin(self) -> None:
        """Compare at the first size; before anything was told."""
        if self._shown(self.k) != self._optimizer.evaluator.size:
            compare_first_at(self._optimizer, self._shown(self.k))

    def ask(self) -> Float64 | None:
        """A candidate (1, d) to render again: the best one, finer, or one that measures noise."""
        if self._next is not None:
            after, self._next = self._next, None
            return self._rise(*after)
        due = self._losses and self._since >= self._every
        if self._again is None and due and self.samples < self._most:
            self._since, self._again = 0, (self._last_told, self._losses[-1])
            return self._last_told[None]
        return None

    def rise_to_finest(self) -> Float64 | None:
        """The best candidate (1, d), to be judged by the finest render; None if it was."""
        return None if self.is_finest else self._rise(self._last, self._most)

    def _rise(self, k: int, samples: int) -> Float64 | None:
        state = self._optimizer.state
        if state.best is None:
            return None
        best, std = state.best, state.search.std
        x = best.solution.x
        if k > self.k:
            spread = std if self._spread is None else self._spread
            pixel = _NARROW / min(self.sizes[self.k])
            std = np.clip(_WIDER * spread, pixel, np.maximum(pixel, self._optimizer.sigma0))
        start = best.mean if best.search_number == state.searches else x
        pixels = math.prod(np.ravel(self.sizes[k])) / math.prod(np.ravel(self.sizes[self.k]))
        for i in range(len(self._halves)):  # as for independent samples, until new pairs come
            self._halves[i] *= self.samples / samples / pixels
        if state.pixel_noise.variance is not None:
            state.pixel_noise.variance *= self.samples / samples
        self.k, self.samples = k, samples
        self._rising, self._again = (start.copy(), std.copy()), None
        self._spreads.clear()
        self._losses, self._told, self._since = [], 0, 0
        self._best, self._best_at = math.inf, 0
        return x[None].copy()

    def received(self, x: Float64, outcome: Outcome) -> str:
        """What becomes of a render of x (d,): "tell", "again" for finer, or "drop"."""
        current = outcome.fineness in (None, (self.k, self.samples))
        if self._again is not None and np.array_equal(x, self._again[0]):
            first, self._again = self._again[1], None
            if current and isinstance(outcome, Rendered):
                self._note_pair(first, outcome)
            return "drop"
        if not current:
            waits = self._rising is None and not self._optimizer.evaluations
            return "again" if waits else "drop"
        if self.k not in self._works:
            failed = outcome if isinstance(outcome, Failed) else self._wrong(outcome)
            if failed is not None:
                self._refused = f"at {_pixels(self.sizes[self.k])} pixels: {failed.reason}"
                self.k += 1
                if self._rising is None:
                    self.begin()
                return "again"
            self._works.append(self.k)
        if isinstance(outcome, Failed):
            if not self._optimizer.evaluations and self._refused:  # it is these parameters
                self._refused, self.k = None, 0
                self.begin()
            return "tell"
        if self._refused is not None:
            warn_user(
                f"renders fail {self._refused}; the smallest that work have "
                f"{_pixels(self.sizes[self.k])}, and are used"
            )
            self._refused = None
        if self._rising is not None:
            start, std = self._rising
            self._rising = None
            compare_finer(self._optimizer, self._shown(self.k), start, std)
        return "tell"

    def _wrong(self, outcome: Rendered) -> Failed | None:
        """What is wrong with a render that has not the size that was asked."""
        evaluator = self._optimizer.evaluator.at_size(self._shown(self.k))
        try:
            evaluator.colors(as_told(self._optimizer, outcome.image), 1, Clipping().note)
        except ImageError as error:
            return Failed.no_fit(error, outcome.image)
        return None

    def _note_pair(self, first: float, outcome: Rendered) -> None:
        evaluator = self._optimizer.evaluator
        try:
            told = as_told(self._optimizer, outcome.image)
            batch = evaluator.as_batch(1, told, None, Clipping().note)
        except ImageError:
            return
        second = float(evaluator.evaluate(1, batch, encode=False).losses[0])
        if math.isfinite(first) and math.isfinite(second):
            self._halves.append((first - second) ** 2 / 2)

    def note(self, x: Float64, loss: float, *, spent: float, left: float) -> None:
        """Note the loss of x (d,), which was told; left: renders of the budget."""
        state = self._optimizer.state
        self._told, self._since, self._last_told = self._told + 1, self._since + 1, x
        self._every = int(min(_EVERY, max(3.0, left / (1 - min(spent, 0.9)) / _SOONER)))
        if loss < self._best:
            self._spread = state.search.std.copy()
            if not loss > self._best - _GAIN * abs(self._best):
                self._best_at = self._told
            self._best = loss
        self._losses.append(loss)
        if len(self._losses) >= self._optimizer.popsize:
            self._note_generation()
        if self._may_rise:
            self._decide(spent, left)

    def _note_generation(self) -> None:
        known = [loss for loss in self._losses if math.isfinite(loss)]
        if known:
            low, middle, high = np.quantile(known, [0.25, 0.5, 0.75])
            self._spreads.append(float(high - low) / _NORMAL)
            if self._typical is None:
                self._typical = float(middle)
        self._losses = []

    def _decide(self, spent: float, left: float) -> None:
        if left <= 1:
            self._next = (self._last, self._most)
        elif self.k < self._last and (
            spent >= SHARE * (self.k + 1) / self._last or self._sees_no_more
        ):
            self._next = (self.k + 1, self.samples)
        elif self._noise_decides:
            self.step_up()

    @property
    def _sees_no_more(self) -> bool:
        """Whether the search has come as near as pictures of this size show."""
        if self._typical is None or not self._best <= _GOOD * self._typical:
            return False
        narrow = self._optimizer.state.search.std.mean() < _NARROW / min(self.sizes[self.k])
        return bool(narrow) or self._told - self._best_at >= _STALE * self._optimizer.popsize

    @property
    def _noise_decides(self) -> bool:
        if len(self._halves) < _FEWEST_PAIRS or len(self._spreads) < _FEWEST_SPREADS:
            return False
        return math.sqrt(np.mean(self._halves)) > _TOLERANCE * float(np.median(self._spreads))

    def step_up(self, *, larger: bool = False) -> None:
        """Render finer from now on: with more samples, or larger, where that is possible."""
        if not self._may_rise:
            return
        if self.k < self._last and (larger or self.samples == self._most):
            self._next = (self.k + 1, self.samples)
        else:
            self._next = (self.k, min(self._most, _RISE * self.samples))

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        state = {name: getattr(self, name) for name in _NUMBERS}
        arrays = {name: np.array(getattr(self, name), np.float64) for name in _ARRAYS}
        rising = None if self._rising is None else list(self._rising)
        state["sizes"] = [list(size) for size in self.sizes]
        return {**state, **arrays, "works": list(self._works), "rising": rising}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where `state_dict` gave `state`."""
        for name in _NUMBERS:
            setattr(self, name, state[name])
        self._halves.extend(state["_halves"].tolist())
        self._spreads.extend(state["_spreads"].tolist())
        if len(state["sizes"]) < len(self.sizes):  # a plan has left some out
            self.sizes = [tuple(size) for size in state["sizes"]]
        self._losses, self._works = state["_losses"].tolist(), list(state["works"])
        rising = state["rising"]
        self._rising = None if rising is None else (rising[0], rising[1])


_NUMBERS = (
    "k", "samples", "cost", "_count", "_since", "_told", "_best", "_best_at", "_typical", "_spread",
)  # fmt: skip
_ARRAYS = ("_halves", "_spreads", "_losses")


_CHEAPER = 0.7  # of the time of the next size: a smaller one that takes more is left out
_OWN = 0.001  # seconds that the optimizer takes for a candidate
_TO_LEARN = 100_000  # renders


def planned(
    schedule: Schedule, optimizer: FIDE, workers: Workers, timeout: float | None, seconds: float
) -> list[str]:
    """Leave out sizes that save no time; lines of the plan of a fit of so many seconds.

    Each size is rendered where the search begins, which counts as cost; where a render fails
    nothing is known.  workers: without a schedule.
    """
    x, took = optimizer.state.search.mean, dict[int, float]()
    for k in (0, *range(len(schedule.sizes))):  # the first loads what the renderer needs
        point: Any = [(x, schedule.keywords(k, schedule.samples, seed=k))]
        for outcome in gathered(workers, point, timeout):
            schedule.pay(k, schedule.samples)
            if isinstance(outcome, Rendered):
                took[k] = outcome.seconds
    if len(took) < len(schedule.sizes):
        return []
    kept = [len(schedule.sizes) - 1]
    for k in reversed(range(kept[0])):
        if took[k] <= _CHEAPER * took[kept[0]]:
            kept.insert(0, k)
    sizes = [_pixels(schedule.sizes[k]) + f" ({duration(took[k])})" for k in kept]
    out = [_pixels(schedule.sizes[k]) for k in took if k not in kept]
    first = f"pictures of {', '.join(sizes)} pixels"
    if out:
        first += f"; not {', '.join(out)}, which save no time"
    schedule.keep(kept)
    return [first, *_pace(took[kept[0]], took[kept[-1]], seconds, max(1, workers.number))]


def _pace(least: float, most: float, seconds: float, number: int) -> list[str]:
    """Lines on how many renders fit in, whose smallest and largest take so many seconds."""
    coarse, fine = (number / (one + _OWN * number) for one in (least, most))
    share = SHARE if least < most else 0.0
    renders = seconds * (share * coarse + (1 - share) * fine)
    second = f"about {renders:,.0f} renders in {duration(seconds)}, {number} at a time"
    if share:
        second += f"; of full size after {duration(share * seconds)} at the latest"
    learning = _TO_LEARN * least / number
    third = f"to learn the renderer first takes about {duration(learning)}: for "
    return [second, f"{third}{math.ceil(learning / seconds) + 1} pictures of it or more"]


def _pixels(size: tuple[int, int]) -> str:
    height, width = size
    return f"{width} x {height}"
