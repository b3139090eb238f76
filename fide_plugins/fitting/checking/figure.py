"""The picture of a check: a strip for each parameter, its values from low to high."""

from __future__ import annotations

import io
from typing import Any, TypeAlias

import numpy as np

from fide_plugins.fitting.checking.measuring import Effect, Facts
from fide_plugins.fitting.checking.report import change_text
from fide_plugins.recording.figures import plain
from fide_plugins.runtime.plotting import new_figure
from fide_plugins.types import Float32

__all__ = ["MOST", "figure"]

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
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


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
    """Text at inches from the upper left corner."""
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
