"""What a check has found: advice in sentences, text for a terminal, data for JSON, a picture."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, TypeAlias

import numpy as np

from fide_plugins.fitting.checking.measuring import FAST, Effect, Facts
from fide_plugins.recording.figures import figure_as_png, plain
from fide_plugins.renderers.naming import described, flat
from fide_plugins.runtime.messages import counted
from fide_plugins.runtime.plotting import new_figure
from fide_plugins.space import Float
from fide_plugins.types import Float32

_LEAST = 2000  # renders of a fit, see docs/howto/budget.md
_EACH, _EACH_OF_MANY, _MANY = 100, 150, 100  # renders of each parameter; of more than so many
_OWN = 0.001  # seconds that the optimizer itself takes for a candidate
_GAIN = 1.3  # times as many renders a second, from which on several workers are worth it
_EYE = 0.5 / 255  # below it nothing changes in a picture of 8 bits
_SLOW_START = 5.0  # times a render, and a tenth of a second: a first render that is told
_TURNS = (180.0, 360.0, math.pi, 2 * math.pi)


def advice(facts: Facts) -> list[str]:
    """Sentences, each with what to do."""
    if not facts.images:
        return ["no render gave an image: mend the renderer first"]
    known = [*_of_images(facts), *_of_values(facts), *_of_parameters(facts)]
    return known if facts.ignores_all else [*known, *_of_fit(facts)]


def budget(facts: Facts) -> int:
    """Renders to plan for a fit."""
    each = _EACH if facts.dim <= _MANY else _EACH_OF_MANY
    return max(_LEAST, each * facts.dim)


def workers(facts: Facts) -> int:
    """Workers to give; 0: render in the process of the fit."""
    if facts.alone < FAST and not facts.kills:
        return 0
    return facts.number if _gain(facts) >= _GAIN else 1


def seconds_of_fit(facts: Facts) -> float:
    """About how long so many renders take on this machine."""
    each = facts.median / max(_gain(facts), 1.0) if workers(facts) > 1 else facts.median
    return budget(facts) * (each + _OWN)


def duration(seconds: float) -> str:
    """A duration in one unit.

    >>> duration(0.00042), duration(1.26), duration(75), duration(1500), duration(14000)
    ('0.42 ms', '1.3 s', '75 s', '25 min', '3.9 h')
    """
    if seconds < 0.9995:
        return f"{seconds * 1000:.2g} ms" if seconds < 0.1 else f"{seconds * 1000:.0f} ms"
    if seconds < 90:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:.0f} min" if seconds < 90 * 60 else f"{seconds / 3600:.2g} h"


def _gain(facts: Facts) -> float:
    if facts.together is None or facts.together <= 0:
        return 1.0
    return facts.number * facts.alone / facts.together


def _of_images(facts: Facts) -> Iterator[str]:
    if facts.failed:
        share = f"{facts.failed} of {counted(facts.renders, 'render')} failed"
        yield (
            f"{share}; a fit withdraws such candidates, but finds more where few fail: {_NARROW}, "
            "or say by constraints which parameters are valid"
        )
    if not facts.centered:
        yield "the middle of the ranges gives no image; begin a fit at values that do (x0)"
    if len(facts.shapes) > 1:
        sizes = " and ".join(map(shape_text, facts.shapes[:3]))
        yield f"the size of the image changes with the parameters ({sizes}); a fit needs one size"
    if facts.constant:
        of = f"{facts.constant} of {counted(facts.images, 'image')}"
        remedy = "" if facts.ignores_all else f"; a search learns little there: {_NARROW}"
        yield f"one color everywhere in {of}{remedy}"
    if facts.first > _SLOW_START * facts.median and facts.first > facts.median + 0.1:
        yield (
            f"the first render of a process takes {duration(facts.first)}; each worker pays that "
            "once, so give --timeout more than it"
        )


_NARROW = "narrow the ranges"


def _of_values(facts: Facts) -> Iterator[str]:
    if facts.not_finite:
        of = f"{facts.not_finite} of {counted(facts.images, 'image')}"
        yield f"NaN or infinite values in {of}; a fit counts them as failed: {_MEND}"
    if facts.bytes_as_floats:
        yield (
            f"values are floats up to {facts.high:.4g}, which looks like 0 to 255; return "
            "image / 255, or whole numbers of type uint8"
        )
    elif facts.outside:
        of = f"{facts.outside} of {counted(facts.images, 'image')}"
        low, high = f"{min(facts.low, 0.0):.3g}", f"{facts.high:.3g}"
        yield (
            f"values outside of [0, 1] ({facts.low:.4g} to {facts.high:.4g} in all) in {of}, which "
            f"a fit clips; if they are no overshoot, give it their range, value_range=({low}, "
            f"{high}) or --value-range {low} {high}"
        )
    if facts.drifts:
        yield (
            "the same parameters gave another image later: the renderer, or its process, keeps "
            "something from render to render; let it depend on its parameters alone"
        )
    elif facts.noise is not None and facts.noise.rms > 1e-5 * facts.span:
        variance = (facts.noise.rms / facts.span) ** 2 / 2
        yield (
            f"two renders of one point differ by {facts.noise.rms / facts.span:.2g} (RMS): a mean "
            f"squared error below about {variance:.1g} cannot be told from noise; more samples "
            "make a fit finer, and --until stalled ends it there"
        )


_MEND = "mend them, or use np.nan_to_num"


def _of_parameters(facts: Facts) -> Iterator[str]:
    silent = facts.silent
    if facts.ignores_all:
        yield "no parameter changes the image; does the renderer read them?"
    elif silent:
        verb, them = ("changes", "it") if len(silent) == 1 else ("change", "them")
        yield (
            f"{_named(silent)} {verb} nothing at any of {counted(facts.points + 1, 'point')}; does "
            f"the renderer read {them}? If it does, leave {them} out of the space"
        )
    hidden = [one.sweep.name for one in facts.effects if one.where == "elsewhere"]
    if hidden:
        verb = "changes" if len(hidden) == 1 else "change"
        yield f"{_named(hidden)} {verb} nothing at the center, but elsewhere"
    for one in facts.effects:
        yield from _of_parameter(one, facts)


def _of_parameter(one: Effect, facts: Facts) -> Iterator[str]:
    name, kind = one.sweep.name, one.sweep.kind
    if one.where == "unknown":
        yield f"what {name} does is not known: too few of its renders gave an image"
    if one.where != "center" or one.change is None:
        return
    if one.change.most < _EYE * facts.span:
        yield f"{name} changes less than a picture of 8 bits can show; widen its range"
    if not isinstance(kind, Float):
        return
    if kind.periodic and not one.ends_alike:
        yield f"{name} is periodic, but its ends give different images; is the range a full turn?"
    turn = any(math.isclose(kind.high - kind.low, turn, rel_tol=0.01) for turn in _TURNS)
    if one.ends_alike and turn and not kind.periodic:
        yield f"both ends of {name} give the same image; if it is an angle, make it periodic"


def _named(names: list[str]) -> str:
    shown = names[:8]
    more = f" and {len(names) - 8} more" if len(names) > 8 else ""
    if more or len(shown) == 1:
        return ", ".join(shown) + more
    return f"{', '.join(shown[:-1])} and {shown[-1]}"


def _of_fit(facts: Facts) -> Iterator[str]:
    number = workers(facts)
    why = {
        0: "renders are so fast that other processes would cost more than they bring",
        1: "several renders at a time are hardly faster than one after the other",
    }.get(number, f"{_gain(facts):.1f} times as fast as one")
    if number == 1 and facts.kills:
        why = "a process of its own can be killed and replaced"
    elif number == 1 and facts.together is None:
        why = "as it was measured"
    yield (
        f"plan {budget(facts):,} renders for {counted(facts.parameters, 'parameter')}, about "
        f"{duration(seconds_of_fit(facts))} here with --workers {number} ({why})"
    )


def shape_text(shapes: tuple[tuple[int, ...], ...]) -> str:
    """Width, height and channels of each view.

    >>> shape_text(((48, 64, 3),)), shape_text(((8, 9, 1), (8, 9, 4)))
    ('64 x 48 pixels, RGB', '9 x 8 pixels, gray; 9 x 8 pixels, RGBA')
    """
    colors = {1: "gray", 3: "RGB", 4: "RGBA"}
    return "; ".join(f"{w} x {h} pixels, {colors[c]}" for h, w, c in shapes)


_NO_CHANGE = {"elsewhere": "elsewhere only", "nowhere": "NOTHING", "unknown": "unknown"}


def lines(name: str, facts: Facts) -> list[str]:
    """Lines of a report; name: of the renderer."""
    made = f"{counted(facts.renders, 'render')} in {duration(facts.seconds)}"
    head = [f"{name}: {counted(facts.parameters, 'parameter')}, {made}"]
    if not facts.images:
        return [*head, *_failures(facts), "", *advice(facts)]
    head += [
        f"image     {shape_text(facts.shapes[0])}, {' and '.join(facts.kinds)}, "
        f"values {facts.low:.4g} to {facts.high:.4g}",
        f"time      {duration(facts.median)} a render (median), at most {duration(facts.slowest)}, "
        f"the first one {duration(facts.first)}",
        f"noise     {_noise(facts)}",
    ]
    if facts.rejected:
        points = counted(facts.rejected, "point")
        head.append(f"invalid   {points} violate constraints, and were not rendered")
    if not facts.centered:
        head.append(f"center    {described(facts.center)}")
    sentences = [f"- {sentence}" for sentence in advice(facts)]
    return [*head, *_failures(facts), "", *_table(facts), "", "before a fit:", *sentences]


def as_data(name: str, facts: Facts) -> dict[str, Any]:
    """The same for JSON."""
    noise = None if facts.noise is None else facts.noise.rms / facts.span
    known = facts.images > 0
    return {
        "renderer": name,
        "dim": facts.dim,
        "renders": facts.renders,
        "points_rejected": facts.rejected,
        "seconds": facts.seconds,
        "sizes": [[list(shape) for shape in shapes] for shapes in facts.shapes],
        "types": facts.kinds,
        "low": facts.low if known else None,
        "high": facts.high if known else None,
        "images_outside_0_1": facts.outside,
        "images_not_finite": facts.not_finite,
        "images_of_one_color": facts.constant,
        "median_s": facts.median,
        "slowest_s": facts.slowest,
        "first_s": facts.first,
        "noise_rms": noise,
        "deterministic": None if noise is None else noise == 0 and not facts.drifts,
        "center": dict(flat(facts.center)) if isinstance(facts.center, dict) else None,
        "failures": [
            {"reason": one.reason, "params": one.params, "count": one.count}
            for one in facts.failures
        ],
        "parameters": [_as_data(one, facts) for one in facts.effects],
        "budget": budget(facts),
        "workers": workers(facts),
        "fit_s": seconds_of_fit(facts) if known else None,
        "advice": advice(facts),
    }


def _as_data(one: Effect, facts: Facts) -> dict[str, Any]:
    return {
        "name": one.sweep.name,
        "unit": one.sweep.unit,
        "values": one.sweep.texts,
        "changes": one.where,
        "change_rms": None if one.change is None else one.change.rms / facts.span,
        "change_most": None if one.change is None else one.change.most / facts.span,
    }


def change_text(one: Effect, facts: Facts) -> str:
    """How much a parameter changes the image, of the range of its values."""
    if one.where != "center" or one.change is None:
        return _NO_CHANGE[one.where]
    if one.change.rms == float("inf"):
        return "size"
    return f"{one.change.rms / facts.span:.2g}"


def _noise(facts: Facts) -> str:
    if facts.noise is None:
        return "not known, since no point was rendered twice"
    if not facts.noise.most and facts.drifts:
        return "none between two renders, but the image was another one later"
    if not facts.noise.most:
        return "none: renders of one point are equal"
    rms, most = facts.noise.rms / facts.span, facts.noise.most / facts.span
    later = ", and more from later ones" if facts.drifts else ""
    return f"renders of one point differ by {rms:.2g} (RMS), at most {most:.2g}{later}"


def _failures(facts: Facts) -> list[str]:
    if not facts.failures:
        return []
    shown = []
    for one in facts.failures[:3]:
        shown.append(f"failed    {counted(one.count, 'render')}: {one.reason}")
        shown += [f"          {line}" for line in _details(one.details, one.params, one.reason)]
    more = len(facts.failures) - 3
    return shown + ([f"          and for {more} more reasons"] if more > 0 else [])


def _details(details: str, params: str, reason: str) -> list[str]:
    found = [line for line in details.splitlines() if line.strip() != reason]
    if not any(params in line for line in found):
        found = [f"with the parameters {params}", *found]
    return found


def _table(facts: Facts) -> list[str]:
    rows = [("parameter", "range", "change (RMS)")]
    for one in facts.effects:
        unit = "" if one.sweep.unit is None else f" [{one.sweep.unit}]"
        change = ", ".join(filter(None, [change_text(one, facts), _failed_at(one)]))
        rows.append((f"{one.sweep.name}{unit}", one.sweep.range, change))
    widths = [max(len(row[i]) for row in rows) for i in range(2)]
    return [f"{a:{widths[0]}}  {b:{widths[1]}}  {c}".rstrip() for a, b, c in rows]


def _failed_at(one: Effect) -> str:
    pairs = zip(one.sweep.texts, one.pictures, strict=True)
    failed = [text for text, picture in pairs if picture is None]
    return f"no image at {', '.join(failed)}" if failed else ""


MOST = 60
"""Parameters that are shown, those that change nothing first of all."""
_INK, _MUTED, _ALARM = "#1a1a1a", "#6b7280", "#c2410c"
_SIDE = 1.35  # inches of the longer side of a panel
_CAPTION = 0.2  # inches above a panel
_NAME = 2.0  # inches of the column of names
_GAP = 0.08  # inches between panels
_TOP = 0.72  # inches of the title
_STRIPS = 12  # of a column
_DPI = 110

Inches: TypeAlias = tuple[float, float]
"""Horizontal, vertical."""


def figure(name: str, facts: Facts) -> bytes:
    """PNG; no window, no global state.  name: of the renderer."""
    effects = _shown(facts)
    shape = next(
        (one.shape for effect in effects for one in effect.pictures if one is not None), (1, 1, 3)
    )
    longer = max(shape[:2])
    height, width = (max(_SIDE * side / longer, 0.3) for side in shape[:2])
    panels = max((len(effect.pictures) for effect in effects), default=1)
    strip = (_NAME + panels * (width + _GAP) + 0.2, height + _CAPTION + _GAP)
    columns = max(1, -(-len(effects) // _STRIPS)) if len(effects) <= 3 * _STRIPS else 3
    rows = max(1, -(-len(effects) // columns))
    size = (columns * strip[0], _TOP + rows * strip[1] + 0.05)
    canvas = new_figure(*size, dpi=_DPI)
    _write(canvas, 0.1, 0.26, plain(name), size, fontsize=12, fontweight="bold", color=_INK)
    _write(canvas, 0.1, 0.52, _subtitle(facts), size, fontsize=7.5, color=_MUTED)
    for i, effect in enumerate(effects):
        corner = (i // rows * strip[0], _TOP + i % rows * strip[1])
        _strip(canvas, effect, facts, corner, (width, height), size)
    return figure_as_png(canvas)


def _shown(facts: Facts) -> list[Effect]:
    """Those that fit, in order; what changes nothing is left out last."""
    rank = sorted(facts.effects, key=lambda one: one.where == "center")[:MOST]
    return [one for one in facts.effects if any(one is other for other in rank)]


def _subtitle(facts: Facts) -> str:
    others = "others at the middle" if facts.centered else "others as at the center"
    if facts.centered and facts.repeated:
        others += ", things of one kind at random values"
    left = len(facts.effects) - MOST
    more = f"; {left} more are not shown" if left > 0 else ""
    usual = (facts.black, facts.white) == (0, 1)
    scaled = "" if usual else f"; {facts.black:.3g} is black, {facts.white:.3g} white"
    return f"{others}{more}{scaled}"


def _strip(
    canvas: Any, effect: Effect, facts: Facts, corner: Inches, panel: Inches, size: Inches
) -> None:
    """Name of one parameter, and its pictures; corner: the upper left one of the strip."""
    left, top = corner
    width, height = panel
    unit = "" if effect.sweep.unit is None else f" [{effect.sweep.unit}]"
    name = plain(effect.sweep.name + unit)[:34]
    _write(canvas, left + 0.1, top + _CAPTION + 0.12, name, size, fontsize=8.5, color=_INK)
    silent = effect.where in ("nowhere", "unknown")
    color = _ALARM if silent else _MUTED
    words = _words(effect, facts)
    _write(canvas, left + 0.1, top + _CAPTION + 0.3, words, size, fontsize=7.5, color=color)
    for k, picture in enumerate(effect.pictures):
        x = left + _NAME + k * (width + _GAP)
        _write(canvas, x, top + 0.15, plain(effect.sweep.texts[k]), size,
               fontsize=7, color=_MUTED)  # fmt: skip
        y = size[1] - top - _CAPTION - height
        box = (x / size[0], y / size[1], width / size[0], height / size[1])
        _panel(canvas.add_axes(box), picture, facts)


def _words(effect: Effect, facts: Facts) -> str:
    text = change_text(effect, facts)
    usual = "changes the size" if text == "size" else f"changes {text}"
    others = {
        "nowhere": "changes nothing",
        "unknown": "not known",
        "elsewhere": "changes nothing here",
    }
    return others.get(effect.where, usual)


def _write(canvas: Any, x: float, y: float, text: str, size: Inches, **style: Any) -> None:
    canvas.text(x / size[0], 1 - y / size[1], text, va="baseline", **style)


def _panel(axes: Any, picture: Float32 | None, facts: Facts) -> None:
    if picture is None:
        axes.text(0.5, 0.5, "no image", fontsize=8, color=_ALARM, ha="center", va="center")
    else:
        shown = np.clip((picture - facts.black) / facts.span, 0, 1)
        axes.imshow(shown, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#d4d4d8")
