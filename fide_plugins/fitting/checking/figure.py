"""The picture of a check: one row a parameter, its values from low to high."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from fide_plugins.fitting.checking.facts import Effect, Facts
from fide_plugins.fitting.checking.report import change_text
from fide_plugins.recording.figures import plain
from fide_plugins.types import Float32

__all__ = ["MOST_ROWS", "figure"]

MOST_ROWS = 40
"""Parameters that are shown, those that change nothing first of all."""
_INK, _MUTED, _ALARM = "#1a1a1a", "#6b7280", "#c2410c"
_SIDE = 1.35  # inches of the longer side of a panel
_CAPTION = 0.2  # inches above a panel
_NAME = 2.0  # inches of the column of names
_DPI = 110


def figure(name: str, facts: Facts) -> bytes:
    """PNG; no window, no global state.  name: of the renderer."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    effects = _shown(facts)
    shape = next(
        (one.shape for effect in effects for one in effect.pictures if one is not None), (1, 1, 3)
    )
    longer = max(shape[:2])
    height, width = (max(_SIDE * side / longer, 0.3) for side in shape[:2])
    columns = max((len(effect.pictures) for effect in effects), default=1)
    row = height + _CAPTION + 0.08
    size = (_NAME + columns * (width + 0.08) + 0.1, 0.75 + row * len(effects))
    canvas = Figure(figsize=size, dpi=_DPI, facecolor="white")
    FigureCanvasAgg(canvas)
    _write(canvas, 0.1, 0.26, plain(name), size, fontsize=12, fontweight="bold", color=_INK)
    _write(canvas, 0.1, 0.52, _subtitle(facts), size, fontsize=7.5, color=_MUTED)
    for i, effect in enumerate(effects):
        top = 0.72 + row * i
        _names(canvas, effect, facts, top + _CAPTION, size)
        for k, picture in enumerate(effect.pictures):
            left = _NAME + k * (width + 0.08)
            _write(canvas, left, top + 0.15, plain(effect.sweep.texts[k]), size,
                   fontsize=7, color=_MUTED)  # fmt: skip
            box = (
                left / size[0], 1 - (top + _CAPTION + height) / size[1],
                width / size[0], height / size[1],
            )  # fmt: skip
            _panel(canvas.add_axes(box), picture, facts)
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _shown(facts: Facts) -> list[Effect]:
    """Those that fit, in order; what changes nothing is left out last."""
    rank = sorted(facts.effects, key=lambda one: one.where == "center")[:MOST_ROWS]
    return [one for one in facts.effects if any(one is other for other in rank)]


def _subtitle(facts: Facts) -> str:
    others = "others at the middle" if facts.centered else "others as at the center"
    left = len(facts.effects) - MOST_ROWS
    more = f"; {left} more are not shown" if left > 0 else ""
    usual = (facts.black, facts.white) == (0, 1)
    scaled = "" if usual else f"; {facts.black:.3g} is black, {facts.white:.3g} white"
    return f"{others}{more}{scaled}"


def _names(
    canvas: Any, effect: Effect, facts: Facts, top: float, size: tuple[float, float]
) -> None:
    unit = "" if effect.sweep.unit is None else f" [{effect.sweep.unit}]"
    _write(canvas, 0.1, top + 0.12, plain(effect.sweep.name + unit)[:34], size,
           fontsize=8.5, color=_INK)  # fmt: skip
    silent = effect.where in ("nowhere", "unknown")
    text = change_text(effect, facts)
    words = {
        "nowhere": "changes nothing",
        "unknown": "not known",
        "elsewhere": "changes nothing here",
    }.get(effect.where, "changes the size" if text == "size" else f"changes {text}")
    _write(canvas, 0.1, top + 0.3, words, size, fontsize=7.5,
           color=_ALARM if silent else _MUTED)  # fmt: skip


def _write(
    canvas: Any, x: float, y: float, text: str, size: tuple[float, float], **style: Any
) -> None:
    """Text at inches from the upper left corner."""
    canvas.text(x / size[0], 1 - y / size[1], text, va="baseline", **style)


def _panel(axes: Any, picture: Float32 | None, facts: Facts) -> None:
    if picture is None:
        axes.text(0.5, 0.5, "failed", fontsize=8, color=_ALARM, ha="center", va="center")
    else:
        shown = np.clip((picture - facts.black) / facts.span, 0, 1)
        axes.imshow(shown, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#d4d4d8")
