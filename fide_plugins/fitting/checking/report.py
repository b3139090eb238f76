"""What a check has found, as text for a terminal and as data for JSON."""

from __future__ import annotations

from typing import Any

from fide_plugins.fitting.checking.advice import (
    advice,
    budget,
    duration,
    seconds_of_fit,
    shape_text,
    workers,
)
from fide_plugins.fitting.checking.facts import Effect, Facts
from fide_plugins.renderers.naming import described, flat
from fide_plugins.runtime.messages import counted

__all__ = ["as_data", "lines"]

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
    """Lines about a failure that are not said yet."""
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
