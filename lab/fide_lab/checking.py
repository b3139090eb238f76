"""`fide check`: renders a few points, and says what to know of a renderer before a fit."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from itertools import combinations
from statistics import median
from typing import Any

import numpy as np

from fide_lab.figures import Panel, draw_image, figure_as_png, new_figure, plain, thumbnail
from fide_plugins.errors import ImageError
from fide_plugins.fitting.pictures import side_by_side
from fide_plugins.fitting.rendering import Failed, Outcome, Renderer
from fide_plugins.fitting.workers import default_number, gathered, workers_for
from fide_plugins.renderers.naming import described, flat
from fide_plugins.runtime.messages import counted, duration
from fide_plugins.space import Float, Space
from fide_plugins.space.constraints import constraints_of
from fide_plugins.types import Float32, Float64
from fide_plugins.validation.images import as_pixels
from fide_plugins.validation.options import seconds_of

_FAST = 0.005  # seconds of a render below which sending it to another process is most of the work
_POINTS, _DRAWN = 8, 1000  # random points; drawn for these
_LOUDER, _ROUNDING = 1.25, 1e-7  # times the noise, of the range: from which a difference is one
_OVERSHOOT = 0.5  # of [0, 1], which is no other range
_LEAST, _EACH, _EACH_OF_MANY, _MANY = 2000, 100, 150, 100  # renders of a fit: docs/howto/budget.md
_OWN = 0.001  # seconds that the optimizer itself takes for a candidate
_SHOWN, _REASONS = 40, 3  # parameters in the picture, failures

Views = list[Float32]
"""Views (H, W, C) of a render; bytes are divided by 255, NaN is 0."""


@dataclass(eq=False)
class Effect:
    """A parameter that can vary, and what it does.

    X: (k, dim), a point for each of its values; texts: these; axes: those on which it lies.
    pictures: (h, w, 3) of its values, reduced; None where the render failed.
    change: largest RMS difference of two of them; None where too few renders gave an image.
    """

    name: str
    label: str
    range: str
    texts: list[str]
    axes: list[int]
    X: Float64
    pictures: list[Float32 | None] = field(default_factory=list)
    change: float | None = None


def effects_in(space: Space | int, center: Float64) -> list[Effect]:
    """Each parameter that can vary, around the point (dim,); nothing is rendered yet."""
    unnamed = isinstance(space, int)
    if isinstance(space, int):
        known = Space(**{f"x{i}": Float(0, 1) for i in range(space)})
    else:
        known = space
    found = []
    for i, (name, kind) in enumerate(known.parameters.items()):
        axes, (low, high, step, _) = known.axes[name], kind.scale
        if not axes:
            continue
        X = np.repeat(center[None], 3, axis=0)
        X[:, axes] = np.array([[0.0], [0.5], [1.0]])
        if step:  # at most five of its values
            count = round((high - low) / step)
            V = np.repeat(known.layout.numbers(center[None]), min(count + 1, 5), axis=0)
            V[:, i] = low + np.round(np.linspace(0, count, len(V))) * step
            X = np.repeat(center[None], len(V), axis=0)
            X[:, axes] = known.layout.points(V)[:, axes]
        values = [dict(flat(params))[name] for params in known.decode_many(X)]
        texts = [f"{value:.4g}" if isinstance(value, float) else str(value) for value in values]
        limits = f"{low:g} to {high:g}" if hasattr(kind, "low") else f"{round(high) + 1} values"
        name = f"x[{i}]" if unnamed else name
        label = name if kind.unit is None else f"{name} [{kind.unit}]"
        found.append(Effect(name, label, limits, texts, axes, X))
    return found


@dataclass
class Failure:
    """Renders that failed alike; details and params: of the first."""

    reason: str
    details: str
    params: str
    count: int = 1


@dataclass(eq=False)
class Facts:
    """What a check has found.

    images: how many renders gave one; rejected: points that violate constraints.
    center: parameters around which others vary; centered: they are the middle of the ranges.
    shapes: (H, W, C) of all views, as they occurred; kinds: types of their numbers.
    not_finite, outside: images with NaN or infinite values, and with values outside of [0, 1].
    median: seconds of a render, without the first one.
    noise: largest RMS difference of renders of one point.
    kills: whether a render ended its process, or was stopped for its time.
    """

    dim: int
    parameters: int
    renders: int = 0
    images: int = 0
    rejected: int = 0
    center: Any = ""
    centered: bool = True
    shapes: list[tuple[tuple[int, ...], ...]] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    low: float = math.inf
    high: float = -math.inf
    not_finite: int = 0
    outside: int = 0
    median: float = 0.0
    number: int = 1
    noise: float | None = None
    kills: bool = False
    effects: list[Effect] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def failed(self) -> int:
        """Renders that gave no image."""
        return sum(one.count for one in self.failures)

    @property
    def ends(self) -> tuple[float, float]:
        """Values that are shown as black and white: 0 and 1, or of another range."""
        black = 0.0 if self.low >= -_OVERSHOOT else self.low
        return black, 1.0 if self.high <= 1 + _OVERSHOOT else self.high

    @property
    def span(self) -> float:
        """From black to white, in which differences are told."""
        return self.ends[1] - self.ends[0]

    @property
    def budget(self) -> int:
        """Renders to plan for a fit."""
        return max(_LEAST, self.dim * (_EACH if self.dim <= _MANY else _EACH_OF_MANY))

    @property
    def workers(self) -> int:
        """Workers to give; 0: render in the process of the fit."""
        return self.number if self.median >= _FAST or self.kills else 0

    @property
    def seconds_of_fit(self) -> float:
        """About how long so many renders take on this machine."""
        return self.budget * (self.median / max(self.workers, 1) + _OWN)

    def shows(self, effect: Effect) -> bool | None:
        """Whether a parameter changes the image by more than noise; None where nobody knows."""
        least = max(_ROUNDING * self.span, _LOUDER * (self.noise or 0.0))
        return None if effect.change is None else effect.change > least


def check(
    render: Callable[[Any], object],
    space: Space | int,
    *,
    workers: int | None = None,
    timeout: float | str | None = None,
) -> Facts:
    """Render a few points, and find what to know before a fit.

    render, space, timeout: as for `fit`.
    workers: renders at a time; None: as many as there are cores, at most 8.

    A render that fails is counted.  Raises OptionError (a ValueError).
    """
    begun = time.perf_counter()
    limit = None if timeout is None else seconds_of("timeout", timeout)
    run = _Check(render, space, limit, 1 if workers is None else min(workers, 1))
    try:
        run.execute(default_number() if workers is None else workers, workers is None)
    finally:
        run.pool.close()
    run.facts.seconds = time.perf_counter() - begun
    return run.facts


class _Check:
    def __init__(
        self, render: Callable[[Any], object], space: Space | int, limit: float | None, number: int
    ) -> None:
        dim = space if isinstance(space, int) else space.dim
        self.facts = Facts(dim, len(effects_in(space, np.full(dim, 0.5))))
        self._renderer = Renderer(render, space if isinstance(space, Space) else None)
        self.pool = workers_for(self._renderer, number, None, limit)
        self._space, self._limit = space, limit
        self._constraints = constraints_of(self._renderer.space, None)
        self._seconds: list[float] = []

    def execute(self, number: int, free: bool) -> None:
        """Render; number: of workers, or one for fast renders where that is `free`."""
        facts, rng = self.facts, np.random.default_rng(0)
        bases = rng.random((_POINTS, facts.dim))
        if self._constraints is not None:
            drawn = rng.random((_DRAWN, facts.dim))
            bases = drawn[self._constraints(drawn) == 0][:_POINTS]
        groups = [] if isinstance(self._space, int) else self._space.groups
        repeated = [axis for block in groups for axis in block]
        middle = np.full(facts.dim, 0.5)
        middle[repeated] = rng.uniform(0.2, 0.8, len(repeated))  # else things hide each other
        for x in (middle, *bases):
            (image,) = self._images(x[None])
            if image is not None:
                break
        else:
            return
        facts.center, facts.centered = self._renderer.params(x), x is middle
        facts.noise = _largest([image, *self._images(np.repeat(x[None], 2, axis=0))])
        facts.number = number
        number = 1 if min(self._seconds) < _FAST and free else number
        if number != self.pool.number:
            self.pool.close()
            self.pool = workers_for(self._renderer, number, None, self._limit)
        for _ in self._images(bases):
            pass
        facts.effects = effects_in(self._space, x)
        for effect in facts.effects:
            images = list(self._images(effect.X))
            effect.change = _largest(images)
            effect.pictures = [None if image is None else _small(image) for image in images]
        facts.median = median(self._seconds[1:] or self._seconds)

    def _images(self, X: Float64) -> Iterator[Views | None]:
        """Image of each point; None, with the reason noted, where there is none."""
        valid = np.full(len(X), True) if self._constraints is None else self._constraints(X) == 0
        self.facts.renders += int(valid.sum())
        self.facts.rejected += int((~valid).sum())
        outcomes = gathered(self.pool, X[valid], self._limit)
        for x, is_valid in zip(X, valid, strict=True):
            yield self._noted(x, next(outcomes)) if is_valid else None

    def _noted(self, x: Float64, outcome: Outcome) -> Views | None:
        if not isinstance(outcome, Failed):
            self._seconds.append(outcome.seconds)
            try:
                return self._views(outcome.image)
            except ImageError as error:
                outcome = Failed(str(error))
        self.facts.kills |= outcome.killed
        kind = outcome.reason.partition(":")[0]
        for known in self.facts.failures:
            if known.reason.partition(":")[0] == kind:
                known.count += 1
                return None
        params = described(self._renderer.params(x))
        self.facts.failures.append(Failure(outcome.reason, outcome.details, params))
        return None

    def _views(self, returned: Any) -> Views:
        """The image, or the views, that a renderer returned, with what they are noted."""
        if returned is None:
            raise ImageError("render returned None; let it return its image")
        several = isinstance(returned, list | tuple) and any(np.ndim(one) >= 2 for one in returned)
        arrays = [as_pixels(one, "the image") for one in (returned if several else [returned])]
        views, facts, lost = [], self.facts, False
        for array in arrays:
            view = np.asarray(array if array.ndim == 3 else array[..., None], np.float32)
            if array.dtype == np.uint8:
                view = view / np.float32(255)
            lost |= not np.isfinite(view).all()
            views.append(np.nan_to_num(view, posinf=0, neginf=0))
        facts.kinds = list(dict.fromkeys([*facts.kinds, *(str(one.dtype) for one in arrays)]))
        facts.shapes = list(dict.fromkeys([*facts.shapes, tuple(view.shape for view in views)]))
        low, high = min(float(v.min()) for v in views), max(float(v.max()) for v in views)
        facts.low, facts.high = min(facts.low, low), max(facts.high, high)
        facts.images += 1
        facts.not_finite += lost
        facts.outside += low < -_ROUNDING or high > 1 + _ROUNDING
        return views


def _largest(images: list[Views | None]) -> float | None:
    """Largest root mean square difference of two images, infinite for two sizes."""
    found = []
    for a, b in combinations(filter(None, images), 2):
        if [view.shape for view in a] != [view.shape for view in b]:
            return math.inf
        pairs = zip(a, b, strict=True)
        apart = [np.subtract(one, two, dtype=np.float64).ravel() for one, two in pairs]
        found.append(float(np.sqrt(np.square(np.concatenate(apart)).mean())))
    return max(found, default=None)


def _small(views: Views) -> Float32:
    """Picture (h, w, 3), views side by side; transparency over white, as a fit does it."""
    shown = []
    for view in views:
        if view.shape[2] == 4:
            view = 1 - view[..., 3:] * (1 - view[..., :3])
        shown.append(np.broadcast_to(view, (*view.shape[:2], 3)))
    return thumbnail(side_by_side(shown))


def advice(facts: Facts) -> Iterator[str]:
    """Sentences, each with what to do."""
    if not facts.images:
        yield "no render gave an image: mend the renderer first"
        return
    if facts.failed:
        yield (
            f"{facts.failed} of {counted(facts.renders, 'render')} failed; a fit withdraws such "
            "candidates: narrow the ranges, or say by constraints which parameters are valid"
        )
    if not facts.centered:
        yield "the middle of the ranges gives no image; begin a fit at values that do (x0)"
    if len(facts.shapes) > 1:
        sizes = " and ".join(map(shape_text, facts.shapes[:3]))
        yield f"the size of the image changes with the parameters ({sizes}); a fit needs one size"
    of = f"of {counted(facts.images, 'image')}"
    if facts.not_finite:
        yield f"NaN or infinite values in {facts.not_finite} {of}; a fit counts them as failed"
    if facts.outside:
        low, high = f"{min(facts.low, 0.0):.3g}", f"{facts.high:.3g}"
        yield (
            f"values outside of [0, 1] in {facts.outside} {of}, which a fit clips; if they are no "
            f"overshoot, give it their range, value_range=({low}, {high}) or --value-range {low} "
            f"{high}; of 0 to 255 return image / 255, or type uint8"
        )
    rms = (facts.noise or 0.0) / facts.span
    if rms > 1e-5:
        yield (
            f"two renders of one point differ by {rms:.2g} (RMS): a mean squared error below about "
            f"{rms**2 / 2:.1g} cannot be told from noise; more samples make a fit finer, and "
            "--until stalled ends it there"
        )
    silent = [one.name for one in facts.effects if facts.shows(one) is False]
    if silent:
        yield (
            f"{', '.join(silent)}: changes nothing at the center; does the renderer read it? If it "
            "does not matter, leave it out of the space"
        )
    if not facts.effects or len(silent) < len(facts.effects):
        yield (
            f"plan {facts.budget:,} renders for {counted(facts.parameters, 'parameter')}, about "
            f"{duration(facts.seconds_of_fit)} here with --workers {facts.workers}"
        )


def shape_text(shapes: tuple[tuple[int, ...], ...]) -> str:
    """Width, height and channels of each view.

    >>> shape_text(((8, 9, 1), (8, 9, 4)))
    '9 x 8 pixels, gray; 9 x 8 pixels, RGBA'
    """
    colors = {1: "gray", 3: "RGB", 4: "RGBA"}
    return "; ".join(f"{w} x {h} pixels, {colors[c]}" for h, w, c in shapes)


def lines(name: str, facts: Facts) -> list[str]:
    """Lines of a report; name: of the renderer."""
    made = f"{counted(facts.renders, 'render')} in {duration(facts.seconds)}"
    shown = [f"{name}: {counted(facts.parameters, 'parameter')}, {made}"]
    if facts.images:
        noise = "not known" if facts.noise is None else f"{facts.noise / facts.span:.2g} (RMS)"
        shown += [
            f"image     {shape_text(facts.shapes[0])}, {' and '.join(facts.kinds)}, "
            f"values {facts.low:.4g} to {facts.high:.4g}",
            f"time      {duration(facts.median)} a render (median)",
            f"noise     {noise}",
        ]
    if facts.rejected:
        points = counted(facts.rejected, "point")
        shown.append(f"invalid   {points} violate constraints, and were not rendered")
    if not facts.centered:
        shown.append(f"center    {described(facts.center)}")
    for one in facts.failures[:_REASONS]:
        shown.append(f"failed    {counted(one.count, 'render')}: {one.reason}")
        details = [] if one.params in one.details else [f"with the parameters {one.params}"]
        shown += [f"          {line}" for line in [*details, *one.details.splitlines()]]
    if facts.images:
        shown += ["", *_table(facts), "", "before a fit:"]
    return [*shown, *(f"- {sentence}" for sentence in advice(facts))]


def change_text(one: Effect, facts: Facts) -> str:
    """How much a parameter changes the image, of the range of its values."""
    if one.change is None or not facts.shows(one):
        return "unknown" if one.change is None else "NOTHING"
    return "size" if math.isinf(one.change) else f"{one.change / facts.span:.2g}"


def _table(facts: Facts) -> list[str]:
    rows = [("parameter", "range", "change (RMS)")]
    for one in facts.effects:
        pairs = zip(one.texts, one.pictures, strict=True)
        failed = ", ".join(text for text, picture in pairs if picture is None)
        change = change_text(one, facts) + (f", no image at {failed}" if failed else "")
        rows.append((one.label, one.range, change))
    widths = [max(len(row[i]) for row in rows) for i in range(2)]
    return [f"{a:{widths[0]}}  {b:{widths[1]}}  {c}" for a, b, c in rows]


def as_data(name: str, facts: Facts) -> dict[str, Any]:
    """The same for JSON."""
    names = ("dim", "renders", "rejected", "failed", "images", "not_finite", "outside")
    more = ("budget", "workers", "seconds", "median", "seconds_of_fit", "shapes", "kinds", "noise")
    effects = [
        {
            "name": one.name,
            "values": one.texts,
            "changes": facts.shows(one),
            "change_rms": None if math.isinf(one.change or 0) else one.change,
        }
        for one in facts.effects
    ]
    return {
        "renderer": name,
        **{key: getattr(facts, key) for key in (*names, *more)},
        "values": [facts.low, facts.high] if facts.images else None,
        "center": dict(flat(facts.center)) if isinstance(facts.center, dict) else None,
        "failures": [asdict(one) for one in facts.failures],
        "parameters": effects,
        "advice": list(advice(facts)),
    }


def figure(name: str, facts: Facts) -> bytes:
    """PNG: each parameter a row, those that change nothing first of all where there are many."""
    effects = sorted(facts.effects, key=lambda one: bool(facts.shows(one)))[:_SHOWN]
    columns = 1 + max((len(one.pictures) for one in effects), default=1)
    canvas = new_figure(1.5 * columns, 0.6 + 1.5 * max(1, len(effects)), dpi=110)
    canvas.set_layout_engine("constrained")
    canvas.suptitle(plain(name), fontsize=12, fontweight="bold")
    grid = canvas.subplots(max(1, len(effects)), columns, squeeze=False)
    for axes in grid.ravel():
        axes.axis("off")
    for effect, row in zip(effects, grid, strict=False):
        words = f"{effect.label}\nchange {change_text(effect, facts)}"
        color = "#1a1a1a" if facts.shows(effect) else "#c2410c"
        row[0].text(0, 0.5, plain(words), fontsize=8.5, color=color, va="center")
        for axes, text, picture in zip(row[1:], effect.texts, effect.pictures, strict=False):
            if picture is None:
                axes.text(0.5, 0.5, f"{plain(text)}: no image", fontsize=8, ha="center")
            else:
                axes.axis("on")
                shown = np.clip((picture - facts.ends[0]) / facts.span, 0, 1)
                draw_image(axes, Panel(plain(text), np.asarray(shown, np.float32)))
    return figure_as_png(canvas)
