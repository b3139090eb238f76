"""Renders around the answer of a fit, two a number, which tell its standard deviations.

Where the image bends, or one side is known only, a nearer step tells a slope from a jump.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.fide import FIDE
from fide_plugins.fitting.pictures import canonical
from fide_plugins.fitting.rendering import Rendered, Workers
from fide_plugins.fitting.workers import gathered
from fide_plugins.runtime.threads import one_thread
from fide_plugins.types import OPEN, Float32, Float64, Indices
from fide_plugins.uncertainty.at_answer import deviations_at, means, pixels_together

MOST_NUMBERS = 500  # of the answer, above which slopes do not fit in little memory
_STEP, _NEARER = 0.005, 0.2  # of the cube; times as far
_LEAST = 0.25  # of a step, below which a wall leaves no side
_TURN = 0.4  # of a period, the farthest step: at half of it both sides are one
_CURVED = 0.25  # energy of the second difference beside that of the first
_STRAIGHTER = 0.5  # of the curvature, below which the nearer step is taken
_ANY = 12**-0.5  # standard deviation of the uniform law
_TINY = 1e-300
_SAME = 2e-6  # by which a GPU renders the same image again


def numbers(optimizer: FIDE) -> Indices:
    """Axes (p,) of numbers: all but integers and choices."""
    return optimizer.axes.continuous


def std_around(
    optimizer: FIDE, workers: Workers, timeout: float | None, most: float, deadline: float
) -> tuple[Float64 | None, int]:
    """Standard deviations (dim,) of the best candidate, None if unknown; number of renders.

    most: renders, at least 1 + 4 p.  deadline: of `time.perf_counter`, when rendering stops.
    NaN, too, where no side of the answer can be rendered.  Unknown, too, for a photograph whose
    renders have edges that jump on most axes: slopes of jumps are too steep.
    """
    axes = numbers(optimizer)
    around = _Around(optimizer, workers, timeout, most, deadline)
    try:
        if not around.is_the_same_again():
            return None, around.renders
        seen = around.look({int(axis): around.either_side(axis, _STEP) for axis in axes})
        _look_closer(around, seen)
        if optimizer.options.photo and 2 * sum(one.least > 0 for one in seen.values()) > len(seen):
            return None, around.renders
    except _OverError:
        return None, around.renders
    _look_farther(around, seen)
    if not seen:
        return None, around.renders
    known = sorted(seen)
    std = np.full(optimizer.dim, np.nan)
    std[known] = around.deviations([seen[axis].slopes for axis in known])
    std[known] = np.maximum(std[known], [seen[axis].least for axis in known])
    return std, around.renders


class _OverError(Exception):
    """There is no room for another render."""


@dataclass(eq=False)
class _Seen:
    """What steps on one axis have shown."""

    slopes: list[Float64]
    curvature: float | None
    step: float
    changed: bool
    least: float = 0.0

    def differs(self, other: _Seen) -> float:
        """Energy of the difference of two slopes beside that of the greater one."""
        pairs = list(zip(self.slopes, other.slopes, strict=True))
        apart = sum(_energy(a - b) for a, b in pairs)
        energies = [sum(_energy(pair[i]) for pair in pairs) for i in (0, 1)]
        return apart / max(*energies, _TINY)


def _look_closer(around: _Around, seen: dict[int, _Seen]) -> None:
    """Look nearer where the image bends, or where one side is known, and replace what was seen."""
    asked = [
        axis
        for axis, one in seen.items()
        if one.changed and (one.curvature is None or one.curvature > _CURVED)
    ]
    found = around.look(
        {axis: around.either_side(axis, _NEARER * seen[axis].step) for axis in asked}
    )
    for axis in asked:
        far, closer = seen[axis], found.get(axis)
        if far.curvature is None and closer is None:  # nothing tells a slope from a jump
            del seen[axis]
            continue
        straight = closer is not None and closer.changed
        if closer is not None and far.curvature is None:
            straight &= far.differs(closer) <= _CURVED
        elif closer is not None and far.curvature is not None:
            bent = np.inf if closer.curvature is None else closer.curvature
            straight &= bent < _STRAIGHTER * far.curvature
        if straight and closer is not None:
            seen[axis] = closer
        else:
            far.least = _NEARER * far.step


def _look_farther(around: _Around, seen: dict[int, _Seen]) -> None:
    """Double the step where nothing changes; what the renders do not suffice for stays unknown."""
    still = {axis: one.step for axis, one in seen.items() if not one.changed}
    while still:
        rounds = max(1.0, around.left // (2 * len(still)))
        factor = max(2.0, (1 / min(still.values())) ** (1 / rounds))
        sides = {axis: around.either_side(axis, factor * s) for axis, s in still.items()}
        sides = {axis: d for axis, d in sides.items() if max(d) > still[axis]}  # else: the end
        try:
            found = around.look(sides)
        except _OverError:
            for axis in sides:
                del seen[axis]
            return
        still = {axis: one.step for axis, one in found.items() if not one.changed}
        for axis, one in found.items():
            if one.changed:
                one.least, seen[axis] = min(0.5 * one.step, _ANY), one
                if factor > 2 and one.least >= OPEN:  # a nearer step may have told it
                    del seen[axis]


def _energy(pixels: Float32 | Float64) -> float:
    return float(np.square(pixels, dtype=np.float64).sum())


@dataclass(eq=False)
class _Around:
    """Renders around the answer x (d,), whose packed image (H, W, 3) is known."""

    optimizer: FIDE
    workers: Workers
    timeout: float | None
    most: float
    deadline: float
    renders: int = 0

    def __post_init__(self) -> None:
        best, views = self.optimizer.state.best, self.optimizer.views.views
        assert best is not None and best.solution.image is not None
        self._x, self._image = best.solution.x, best.solution.image
        periodic = self.optimizer.axes.periodic
        self._periodic = np.zeros(len(self._x), bool) if periodic is None else periodic
        p = len(numbers(self.optimizer))
        self._together = [pixels_together(p, *view.size, 3) for view in views]

    @property
    def left(self) -> float:
        return self.most - self.renders

    def is_the_same_again(self) -> bool:
        """Whether the answer has the same image when it is rendered again."""
        (again,) = self._render(self._x[None])
        return again is not None and bool(np.abs(again - self._image).max() <= _SAME)

    def either_side(self, axis: int, step: float) -> tuple[float, float]:
        """Distances of the points below and above on an axis; 0: a wall, or not valid."""
        return self._reach(axis, -step), self._reach(axis, step)

    def look(self, sides: Mapping[int, tuple[float, float]]) -> dict[int, _Seen]:
        """What points at such distances show; axes of which nothing can be rendered are missing."""
        steps = [
            (axis, sign * distance)
            for axis, pair in sides.items()
            for sign, distance in zip((-1, 1), pair, strict=True)
            if distance
        ]
        X = np.array([self._point(axis, step) for axis, step in steps]).reshape(-1, len(self._x))
        images, seen = self._render(X), {}
        for axis, (low, high) in sides.items():  # in the order of X
            below = next(images) if low else None
            above = next(images) if high else None
            if below is not None or above is not None:
                seen[axis] = self._seen(below, above, low, high)
        return seen

    @one_thread
    def deviations(self, slopes: Sequence[Sequence[Float64]]) -> Float64:
        """(p,), standard deviations, of p reduced slopes of each view."""
        views, image = self.optimizer.views, self._image
        residuals = views.differences(views.target, image)
        weights = views.differences(np.ones_like(image), np.zeros_like(image))
        images = [one[0].astype(np.float64) for one in views.split(image[None])]
        return deviations_at(
            [np.array(one) for one in zip(*slopes, strict=True)],
            self._reduced(residuals),
            self._reduced(images),
            self._reduced(weights),
            self._together,
        )

    def _reach(self, axis: int, step: float) -> float:
        """How far a step gets, if that is far enough and valid; else 0."""
        if self._periodic[axis]:
            distance = min(abs(step), _TURN)
        else:
            distance = abs(min(max(float(self._x[axis]) + step, 0.0), 1.0) - float(self._x[axis]))
            if distance < _LEAST * abs(step):
                return 0.0
        validity = self.optimizer.validity
        point = self._point(axis, float(np.copysign(distance, step)))
        return distance if validity is None or validity.allows(point) else 0.0

    def _point(self, axis: int, step: float) -> Float64:
        point = self._x.copy()
        moved = point[axis] + step
        point[axis] = moved % 1.0 if self._periodic[axis] else min(max(moved, 0.0), 1.0)
        return point

    def _seen(self, below: Float32 | None, above: Float32 | None, low: float, high: float) -> _Seen:
        """What images (H, W, 3) at either side show; None: none there."""
        at, curvature = self._image, None
        if below is not None and above is not None:
            right, left = (above - at) / np.float32(high), (at - below) / np.float32(low)
            bent, straight = _energy(right - left), _energy(right + left)
            curvature = bent / max(straight, _TINY)
        changed = any(one is not None and np.abs(one - at).max() > _SAME for one in (below, above))
        low, high = low if below is not None else 0.0, high if above is not None else 0.0
        apart = self.optimizer.views.differences(
            at if above is None else above, at if below is None else below
        )
        slopes = [one / (low + high) for one in self._reduced(apart)]
        return _Seen(slopes, curvature, max(low, high), changed)

    def _reduced(self, pixels: Sequence[Float64]) -> list[Float64]:
        """Of each view (H, W, 3), means of k x k pixels."""
        return [means(one, k) for one, k in zip(pixels, self._together, strict=True)]

    def _render(self, X: Float64) -> Iterator[Float32 | None]:
        """Packed images (H, W, 3) of points X (n, d), as they come; None: the render failed."""
        outcomes = gathered(self.workers, X, self.timeout)
        if self.renders + len(X) > self.most:
            raise _OverError
        for _ in X:
            if time.perf_counter() > self.deadline:
                raise _OverError
            self.renders += 1
            outcome, image = next(outcomes), None
            if isinstance(outcome, Rendered):
                with suppress(ImageError):  # no image that fits is a render that failed, too
                    image = canonical(self.optimizer, outcome.image)
            yield image
