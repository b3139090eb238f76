"""Renders a few points, in five steps, and finds what they say of the renderer.

1. The middle of the box, or, where that fails, one of some random points: the center.  Things of
   one kind would all be at one place there, so each has random values of its own.
2. The center twice more, alone: how long a render takes, and whether two are equal.
3. Random points, and each parameter's values around the center, several at a time.
4. What changes nothing there, at some of the random points.
5. The center again, as many at a time: what further workers bring, and whether it is as it was.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import combinations
from statistics import median
from typing import Any, Literal

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.fitting.pictures import side_by_side
from fide_plugins.fitting.rendering import Failed, Outcome, Renderer
from fide_plugins.fitting.workers import Workers, default_number, gathered, workers_for
from fide_plugins.recording.figures import thumbnail
from fide_plugins.renderers.naming import described, flat
from fide_plugins.space import Float, Kind, Space
from fide_plugins.space.constraints import Constraints, constraints_of
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.images import as_pixels
from fide_plugins.validation.options import seconds_of
from fide_plugins.validation.pixels import Pixels

MOST = 5
"""Values of an integer or a choice, at most."""
_ENDS_AND_MIDDLE = np.array([[0.0], [0.5], [1.0]])
_ELSEWHERE = (0.37, 0.71)  # of an axis, around which it is closed: no value twice, no symmetry


@dataclass(frozen=True)
class Sweep:
    """One parameter and its values.

    name, unit: of the parameter.  axes: of the cube.  range: in words.
    X: (k, dim), a point for each value.  texts: of the values.
    kind: None without a space.
    """

    name: str
    unit: str | None
    axes: list[int]
    range: str
    X: Float64 = field(repr=False)
    texts: list[str]
    kind: Kind | None


def sweeps(space: Space | int, center: Float64) -> list[Sweep]:
    """A sweep around the point (dim,) of each parameter that can vary, in order."""
    if isinstance(space, int):
        return [_of_axis(i, center) for i in range(space)]
    layout, found = space.layout, []
    for i, (name, kind) in enumerate(space.parameters.items()):
        axes = space.axes[name]
        if not axes:
            continue
        numbers = _numbers(kind)
        placed = _ENDS_AND_MIDDLE
        if numbers:
            V = np.repeat(layout.numbers(center[None]), len(numbers), axis=0)
            V[:, i] = numbers
            placed = layout.points(V)[:, axes]
        X = np.repeat(center[None], len(placed), axis=0)
        X[:, axes] = placed
        values = [dict(flat(params))[name] for params in space.decode_many(X)]
        texts = [text_of(value) for value in values]
        found.append(Sweep(name, kind.unit, axes, _range(kind), X, texts, kind))
    return found


def middle_of(space: Space | int, rng: np.random.Generator) -> Float64:
    """The middle of the box (dim,); repeated groups have random values, so that they differ."""
    middle = np.full(space if isinstance(space, int) else space.dim, 0.5)
    repeated = [] if isinstance(space, int) else [axis for block in space.groups for axis in block]
    middle[repeated] = rng.uniform(0.2, 0.8, len(repeated))
    return middle


def other_values(sweep: Sweep, base: Float64) -> Float64:
    """Points (n, dim) where all but this parameter are as at the point (dim,), and it is not."""
    if len(sweep.axes) > 1 or (sweep.kind is not None and sweep.kind.scale.step):
        X = np.repeat(base[None], len(sweep.X), axis=0)
        X[:, sweep.axes] = sweep.X[:, sweep.axes]
        return X
    X = np.repeat(base[None], len(_ELSEWHERE), axis=0)
    X[:, sweep.axes[0]] = (base[sweep.axes[0]] + np.array(_ELSEWHERE)) % 1.0
    return X


def text_of(value: Any) -> str:
    """A value in four digits."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _of_axis(i: int, center: Float64) -> Sweep:
    X = np.repeat(center[None], 3, axis=0)
    X[:, i] = (0.0, 0.5, 1.0)
    return Sweep(f"x[{i}]", None, [i], "0 to 1", X, ["0", "0.5", "1"], None)


def _numbers(kind: Kind) -> list[float]:
    """Numbers of its values, at most five of them; none if it is continuous."""
    low, high, step, log = kind.scale
    if not step:
        return []
    count = round((high - low) / step)
    if log and count >= MOST:
        steps = np.geomspace(low, high, MOST) - low
    else:
        steps = np.linspace(0, count, min(count + 1, MOST)) * step
    return list(dict.fromkeys(float(low + round(one / step) * step) for one in steps))


def _range(kind: Kind) -> str:
    low, high, step, log = kind.scale
    if not isinstance(kind, Float) and not hasattr(kind, "low"):
        return f"{round(high) + 1} values"
    notes = ["log"] * log + ["periodic"] * (getattr(kind, "periodic", False) is True)
    if step and step != 1:
        notes.append(f"step {step:g}")
    return f"{low:g} to {high:g}" + (f" ({', '.join(notes)})" if notes else "")


@dataclass(frozen=True, eq=False)
class Image:
    """What was rendered.

    views: (H, W, C) each; of whole numbers divided by 255, of others as they are, 0 for NaN.
    kinds: type of the numbers of each view, as the renderer returned it.
    low, high: least and largest finite value; bytes are divided by 255.
    not_finite: number of values that are NaN or infinite.
    constant: whether each view has one color.
    """

    views: list[Float32]
    kinds: tuple[str, ...]
    low: float
    high: float
    not_finite: int
    constant: bool

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """(H, W, C) of each view."""
        return tuple(view.shape for view in self.views)


@dataclass(frozen=True)
class Difference:
    """Of two images, in units of their values.

    rms: root mean square.  most: largest absolute value.
    """

    rms: float
    most: float


def image_of(returned: Any) -> Image:
    """The image, or the list of views, that a renderer returned."""
    if returned is None:
        raise ImageError("render returned None; let it return its image")
    several = isinstance(returned, list | tuple) and any(np.ndim(one) >= 2 for one in returned)
    given = list(returned) if several else [returned]
    arrays = [
        as_pixels(one, f"the image of view {i}" if several else "the image")
        for i, one in enumerate(given)
    ]
    views, bad = [], 0
    for array in arrays:
        view, wrong = _floats(array if array.ndim == 3 else array[..., None])
        views.append(view)
        bad += wrong
    return Image(
        views,
        tuple(str(array.dtype) for array in arrays),
        min(float(view.min()) for view in views),
        max(float(view.max()) for view in views),
        bad,
        all(bool((view == view[:1, :1]).all()) for view in views),
    )


def _floats(array: Pixels) -> tuple[Float32, int]:
    """Values (H, W, C), and how many of them were not finite."""
    values = np.asarray(array, np.float32)
    if array.dtype == np.uint8:
        values = values / np.float32(255)
    finite = np.isfinite(values)
    bad = int(values.size - np.count_nonzero(finite))
    if bad:
        least = values[finite].min() if finite.any() else np.float32(0)
        values = np.where(finite, values, least)
    return values, bad


def difference(a: Image, b: Image) -> Difference:
    """Of two images; infinite where they have different sizes."""
    if a.shapes != b.shapes:
        return Difference(np.inf, np.inf)
    square, count, most = 0.0, 0, 0.0
    for one, other in zip(a.views, b.views, strict=True):
        apart = one.astype(np.float64) - other
        square += float(np.square(apart).sum())
        count += apart.size
        most = max(most, float(np.abs(apart).max()))
    return Difference((square / count) ** 0.5, most)


def mean_of(images: list[Image]) -> Image:
    """The first of images of one size, with the mean of all as its views."""
    views = zip(*(image.views for image in images), strict=True)
    return replace(images[0], views=[np.mean(each, axis=0) for each in views])


def small(image: Image) -> Float32:
    """Picture (h, w, 3) of an image, views side by side, with the values that it has."""
    return thumbnail(side_by_side([_colors(view) for view in image.views]))


def _colors(view: Float32) -> Float32:
    """RGB (H, W, 3); transparency over white, as a fit does it."""
    if view.shape[2] == 4:
        return 1 - view[..., 3:] * (1 - view[..., :3])
    return np.repeat(view, 3, axis=2) if view.shape[2] == 1 else view


_REAL = re.compile(r"-?\d*\.\d+(e[-+]?\d+)?")


Where = Literal["center", "elsewhere", "nowhere", "unknown"]
"""Where a parameter changes the image; unknown: too few of its renders gave one."""


@dataclass(eq=False)
class Effect:
    """What one parameter does.

    pictures: (h, w, 3) of its values, reduced; None where the render failed.
    change: largest difference of two of them; None if there are no two.
    ends_alike: whether its low and its high value give the same image, and the middle another one.
    """

    sweep: Sweep
    pictures: list[Float32 | None]
    change: Difference | None
    where: Where
    ends_alike: bool


@dataclass
class Failure:
    """Renders that gave no image for one reason.

    reason: in one line; details: of the first; params: its parameters, in a line.
    """

    reason: str
    details: str
    params: str
    count: int = 1

    @property
    def kind(self) -> tuple[str, str]:
        """What failures of one kind share: the message, but for the real numbers in it."""
        end = self.details.rpartition("\n")[2]  # of a traceback, or of what a program printed
        return _REAL.sub("", self.reason), _REAL.sub("", end)


@dataclass(eq=False)
class Facts:
    """What a check has found.

    dim: axes of the search.  parameters: that can vary.  renders: how many were made.
    repeated: whether some are of things of one kind, which then have random values at the center.
    images: how many of them gave an image.  rejected: points that violate constraints.
    center: parameters of the point around which the others vary; `centered`: it is the middle.
    shapes: those that occurred, each of all views, in the order in which they were seen.
    kinds: types of numbers that occurred.  low, high: of all values.
    not_finite, constant, outside: numbers of images with NaN or infinite values, of one color, and
        with values below 0 or above 1.
    first, alone, slowest: seconds of the first render; of one at the center, alone, later; longest.
    median: seconds of all but the first.
    together, number: seconds of as many renders at a time, each; None where one is too fast.
    noise: largest difference of two renders of one point; None if there are no two.
    drifts: whether renders of the center at the end differ from the first ones by more than these
        from each other.
    points: at how many points parameters were tried that change nothing at the center.
    kills: whether a render ended its process, or was stopped for its time.
    """

    dim: int
    parameters: int
    repeated: bool = False
    renders: int = 0
    images: int = 0
    rejected: int = 0
    center: dict[str, Any] | str = ""
    centered: bool = True
    shapes: list[tuple[tuple[int, ...], ...]] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    low: float = float("inf")
    high: float = float("-inf")
    not_finite: int = 0
    constant: int = 0
    outside: int = 0
    first: float = 0.0
    alone: float = 0.0
    median: float = 0.0
    slowest: float = 0.0
    together: float | None = None
    number: int = 1
    noise: Difference | None = None
    drifts: bool = False
    points: int = 0
    kills: bool = False
    effects: list[Effect] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def failed(self) -> int:
        """Renders that gave no image."""
        return sum(one.count for one in self.failures)

    @property
    def silent(self) -> list[str]:
        """Names of parameters that change nothing anywhere."""
        return [one.sweep.name for one in self.effects if one.where == "nowhere"]

    @property
    def ignores_all(self) -> bool:
        """Whether no parameter changes the image."""
        return bool(self.effects) and len(self.silent) == len(self.effects)

    @property
    def bytes_as_floats(self) -> bool:
        """Whether the values are floats that look like 0 to 255."""
        low, high = _LOOKS_LIKE_BYTES
        return low <= self.high <= high and self.low >= -0.1 * self.high

    @property
    def black(self) -> float:
        """Lower end of the range in which images are shown."""
        return 0.0 if self.bytes_as_floats or self.low >= -_OVERSHOOT else self.low

    @property
    def white(self) -> float:
        """Upper end of it: 1 where values lie in [0, 1]."""
        if self.bytes_as_floats:
            return 255.0
        return 1.0 if self.high <= 1 + _OVERSHOOT else self.high

    @property
    def span(self) -> float:
        """Width of it, in which differences are told."""
        return self.white - self.black


_LOOKS_LIKE_BYTES = 32.0, 280.0  # largest value; a picture up to 10 is one of high range
_OVERSHOOT = 0.5  # of [0, 1]: a renderer that overshoots is none of another range


FAST = 0.005
"""Seconds of a render below which sending it to another process is most of the work."""
_POINTS = 8  # random points
_DRAWN = 1000  # random points of which the first valid ones are taken, where there are constraints
_TRIED = 3  # of them, for parameters that change nothing at the center
_LATE = 6  # renders of the center at the end, where it may have drifted
_LOUDER = 1.25  # times the noise, from which on a difference is one
_ROUNDING = 1e-7  # of the range
_ALIKE = 0.02  # of the largest change, by which the ends of a periodic parameter may differ


def check(
    render: Callable[[Any], object],
    space: Space | int,
    *,
    workers: int | None = None,
    timeout: float | str | None = None,
    told: Callable[[int, float], None] = lambda renders, seconds: None,
) -> Facts:
    """Render a few points, and find what to know before a fit.

    render, space, timeout: as for `fit`.
    workers: renders at a time; None: as many as there are cores, at most 8.
    told: gets how many renders are still to come at least, and about how many seconds they take.

    A render that fails is counted.  Raises OptionError (a ValueError).
    """
    begun = time.perf_counter()
    limit = None if timeout is None else seconds_of("timeout", timeout)
    renderer = Renderer(render, space if isinstance(space, Space) else None)
    dim = space.dim if isinstance(space, Space) else space
    count = len(sweeps(space, np.full(dim, 0.5)))
    facts = Facts(dim, count, repeated=isinstance(space, Space) and bool(space.families))
    run = _Check(renderer, facts, limit, constraints_of(renderer.space, None))
    try:
        run.execute(space, workers, told)
    finally:
        run.close()
    run.facts.seconds = time.perf_counter() - begun
    return run.facts


class _Check:
    def __init__(
        self,
        renderer: Renderer,
        facts: Facts,
        limit: float | None,
        constraints: Constraints | None,
    ) -> None:
        self.facts = facts
        self._renderer, self._limit, self._constraints = renderer, limit, constraints
        self._pool: Workers = workers_for(renderer, 1, None, limit)
        self._seconds: list[float] = []
        self._rng = np.random.default_rng(0)

    def close(self) -> None:
        self._pool.close()

    def execute(
        self, space: Space | int, workers: int | None, told: Callable[[int, float], None]
    ) -> None:
        facts = self.facts
        bases = self._rng.random((_POINTS, facts.dim))
        if self._constraints is not None:
            drawn = self._rng.random((_DRAWN, facts.dim))
            bases = drawn[self._constraints(drawn) == 0][:_POINTS]
        found = self._center(middle_of(space, self._rng), bases)
        if found is None:
            return
        center, image = found
        repeats = [image, *self._repeated(center, 2)]
        facts.alone = min(self._seconds[1:], default=facts.first)
        facts.noise = _largest(repeats)
        self._take(workers)
        plan = sweeps(space, center)
        count = _POINTS + sum(len(sweep.X) for sweep in plan)
        told(count, count * facts.alone / self._pool.number)
        known = [(x, self._seen(x, outcome)) for x, outcome in self._rendered(bases)]
        noise = 0.0 if facts.noise is None else facts.noise.rms
        facts.effects = [self._effect(sweep, noise) for sweep in plan]
        self._elsewhere([(x, image) for x, image in known if image is not None])
        self._together(center, repeats)
        facts.median = median(self._seconds[1:] or self._seconds)
        facts.slowest = max(self._seconds[1:] or self._seconds)

    # -- steps -------------------------------------------------------------------------------------

    def _center(self, middle: Float64, bases: Float64) -> tuple[Float64, Image] | None:
        """The middle and its image, or the first of the other points that has one."""
        for x in np.concatenate([middle[None], bases]):
            ((_, outcome),) = self._rendered(x[None])
            image = self._seen(x, outcome)
            if image is not None:
                self.facts.center = self._renderer.params(x)
                self.facts.centered = self.facts.renders + self.facts.rejected == 1
                self.facts.first = self._seconds[0]
                return x, image
        return None

    def _take(self, workers: int | None) -> None:
        fast = self.facts.alone < FAST
        number = (1 if fast else default_number()) if workers is None else workers
        if number != self._pool.number:
            self._pool.close()
            self._pool = workers_for(self._renderer, number, None, self._limit)

    def _effect(self, sweep: Sweep, noise: float) -> Effect:
        images = [self._seen(x, outcome) for x, outcome in self._rendered(sweep.X)]
        change = _largest(images)
        where: Where = "center"
        if change is None:
            where = "unknown"
        elif not self._changes(change, noise):
            where = "nowhere"
        pictures = [None if image is None else small(image) for image in images]
        return Effect(sweep, pictures, change, where, _ends_alike(images, change, noise))

    def _elsewhere(self, known: list[tuple[Float64, Image]]) -> None:
        """Try what changes nothing at the center at other points."""
        silent = [effect for effect in self.facts.effects if effect.where in ("nowhere", "unknown")]
        if not silent:
            return
        for x, image in known[:_TRIED]:
            self.facts.points += 1
            repeats: list[Image | None] = [image]
            if self.facts.noise is not None and self.facts.noise.most:
                repeats += self._repeated(x, 1)
            level = _largest(repeats)
            for effect in [one for one in silent if one.where in ("nowhere", "unknown")]:
                others = other_values(effect.sweep, x)
                images = [self._seen(point, outcome) for point, outcome in self._rendered(others)]
                change = _largest([image, *images])
                if change is not None:
                    louder = self._changes(change, 0.0 if level is None else level.rms)
                    effect.where = "elsewhere" if louder else "nowhere"

    def _together(self, center: Float64, repeats: list[Image | None]) -> None:
        """The center once more, by all workers at a time."""
        facts = self.facts
        before = len(self._seconds)
        number = self._pool.number
        again = self._repeated(center, number)
        taken = self._seconds[before:]
        facts.number = number
        if number > 1 and taken:
            facts.together = median(taken)
        if _differ(repeats, again):
            again += self._repeated(center, max(0, _LATE - number))  # that it was no chance
            facts.drifts = _differ(repeats, again)

    # -- renders -----------------------------------------------------------------------------------

    def _rendered(self, X: Float64) -> Iterator[tuple[Float64, Outcome | None]]:
        """Each point with its outcome; None for one that violates constraints."""
        valid = np.full(len(X), True) if self._constraints is None else self._constraints(X) == 0
        self.facts.renders += int(valid.sum())
        self.facts.rejected += int((~valid).sum())
        outcomes = gathered(self._pool, X[valid], self._limit)
        for x, is_valid in zip(X, valid, strict=True):
            yield x, next(outcomes) if is_valid else None

    def _repeated(self, x: Float64, times: int) -> list[Image | None]:
        X = np.repeat(x[None], times, axis=0)
        return [self._seen(x, outcome) for _, outcome in self._rendered(X)]

    def _seen(self, x: Float64, outcome: Outcome | None) -> Image | None:
        """The image of a render, noted; None, with the reason noted, where there is none."""
        if outcome is None:
            return None
        if isinstance(outcome, Failed):
            self._note_failure(outcome, x)
            return None
        self._seconds.append(outcome.seconds)
        try:
            image = image_of(outcome.image)
        except ImageError as error:
            self._note_failure(Failed(str(error)), x)
            return None
        facts = self.facts
        facts.images += 1
        if image.shapes not in facts.shapes:
            facts.shapes.append(image.shapes)
        facts.kinds += [kind for kind in dict.fromkeys(image.kinds) if kind not in facts.kinds]
        facts.low, facts.high = min(facts.low, image.low), max(facts.high, image.high)
        facts.not_finite += image.not_finite > 0
        facts.constant += image.constant
        facts.outside += image.low < -_ROUNDING or image.high > 1 + _ROUNDING
        return image

    def _note_failure(self, failed: Failed, x: Float64) -> None:
        self.facts.kills |= failed.killed
        params = described(self._renderer.params(x))
        failure = Failure(failed.reason, failed.details, params)
        for known in self.facts.failures:
            if known.kind == failure.kind:
                known.count += 1
                return
        self.facts.failures.append(failure)

    def _changes(self, change: Difference, noise: float) -> bool:
        return change.most > _ROUNDING * self.facts.span and change.rms > _LOUDER * noise


def _largest(images: list[Image | None]) -> Difference | None:
    found = [difference(a, b) for a, b in combinations(filter(None, images), 2)]
    return max(found, key=lambda one: one.rms, default=None)


def _differ(early: list[Image | None], late: list[Image | None]) -> bool:
    """Whether late renders of a point differ from early ones by more than from each other."""
    noise, first, last = _largest(early), list(filter(None, early)), list(filter(None, late))
    if noise is None or not last:
        return False
    if not noise.most:
        return any(difference(first[0], image).most > 0 for image in last)
    among = max(noise.rms, (_largest(late) or noise).rms)
    if np.isinf(among):  # of several sizes
        return False
    return difference(mean_of(first), mean_of(last)).rms > _LOUDER * among


def _ends_alike(images: list[Image | None], change: Difference | None, noise: float) -> bool:
    """Whether the first and the last image are equal but for noise, and others are not."""
    first, last = images[0], images[-1]
    if change is None or first is None or last is None or len(images) < 3:
        return False
    apart = difference(first, last)
    loud = change.rms > max(noise, 0.0) * 4 and change.most > 0
    return loud and apart.rms <= max(_LOUDER * noise, _ALIKE * change.rms)
