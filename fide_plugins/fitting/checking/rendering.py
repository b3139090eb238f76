"""Renders a few points, in five steps, and finds what they say of the renderer.

1. The middle of the box, or, where that fails, one of some random points: the center.  Things of
   one kind would all be at one place there, so each has random values of its own.
2. The center twice more, alone: how long a render takes, and whether two are equal.
3. Random points, and each parameter's values around the center, several at a time.
4. What changes nothing there, at some of the random points.
5. The center again, as many at a time: what further workers bring, and whether it is as it was.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import combinations
from statistics import median
from typing import Any

import numpy as np

from fide_plugins.errors import ImageError
from fide_plugins.fitting.checking.facts import Effect, Facts, Failure, Where
from fide_plugins.fitting.checking.pixels import (
    Difference,
    Image,
    difference,
    image_of,
    mean_of,
    small,
)
from fide_plugins.fitting.checking.values import Sweep, middle_of, other_values, sweeps
from fide_plugins.fitting.durations import seconds_of
from fide_plugins.fitting.rendering import Failed, Outcome, Renderer
from fide_plugins.fitting.workers.base import Workers
from fide_plugins.fitting.workers.choice import default_number, workers_for
from fide_plugins.fitting.workers.gather import gathered
from fide_plugins.renderers.naming import described
from fide_plugins.space import Space
from fide_plugins.space.constraints import Constraints, constraints_of
from fide_plugins.types import Float64

__all__ = ["check"]

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
    """A check under way."""

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
        """Stop the workers."""
        self._pool.close()

    def execute(
        self, space: Space | int, workers: int | None, told: Callable[[int, float], None]
    ) -> None:
        """All steps."""
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
        """Render with so many workers from now on."""
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
    """Largest difference of two of them; None if there are no two."""
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
