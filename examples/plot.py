"""Read a plot: the curve, the colors and the style that somebody gave to Matplotlib.

    python examples/plot.py          # a short run
    python examples/plot.py 3000     # the run of the gallery

The renderer is Matplotlib itself; ten parameters, one of them a whole number, one a choice.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fide_plugins import Choice, Float, Int, Space, fit

SPACE = Space(
    amplitude=Float(0.2, 1, unit="V"), decay=Float(0.05, 1, unit="1/s"),
    frequency=Float(0.3, 1.2, unit="Hz"), phase=Float(0, 360, unit="deg", periodic=True),
    width=Float(1, 6, unit="pt"), red=Float(0, 1), green=Float(0, 1), blue=Float(0, 1),
    bars=Int(0, 4), style=Choice("-", "--"),
)  # fmt: skip
TRUTH: dict[str, Any] = {
    "amplitude": 0.8, "decay": 0.3, "frequency": 0.7, "phase": 60.0, "width": 3.0,
    "red": 0.85, "green": 0.3, "blue": 0.1, "bars": 3, "style": "-",
}  # fmt: skip
T = np.linspace(0, 5, 200)


def render(p: dict[str, Any]) -> NDArray[np.uint8]:
    """The plot, (96, 128, 3)."""
    figure = Figure(figsize=(1.28, 0.96), dpi=100)
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_axes(
        (0.08, 0.08, 0.88, 0.88), xticks=[], yticks=[], xlim=(0, 5), ylim=(-1, 1)
    )
    y = p["amplitude"] * np.exp(-p["decay"] * T)
    y *= np.sin(2 * np.pi * p["frequency"] * T + np.radians(p["phase"]))
    axes.bar(np.arange(p["bars"]) + 1, 0.6, width=0.4, bottom=-1, color="0.8")
    color = p["red"], p["green"], p["blue"]
    axes.plot(T, y, p["style"], color=color, linewidth=p["width"])
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


def main(budget: int) -> None:
    out = f"runs/plot-{budget}"
    result = fit(
        render, render(TRUTH), SPACE, budget=budget, workers=2, out=out, resume=True, seed=0
    )
    print(result)
    for name, true in TRUTH.items():
        found = result.params[name]
        print(
            f"{name:10} {true!s:>6}  {found if isinstance(found, str | int) else round(found, 3)}"
        )
    print(f"look at {out}/summary.png")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 150)
