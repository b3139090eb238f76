"""What a check means for a fit, in sentences, the gravest first."""

from __future__ import annotations

import math
from collections.abc import Iterator

from fide_plugins.fitting.checking.facts import Effect, Facts
from fide_plugins.fitting.checking.rendering import FAST
from fide_plugins.runtime.messages import counted
from fide_plugins.space import Float

__all__ = ["advice", "budget", "duration", "workers"]

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
    """How many times as fast several workers are as one."""
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
    """Names in a sentence, at most eight."""
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
