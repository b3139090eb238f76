"""A picture of the paper's smaller figures: epochs and time, dual annealing inside, gradients.

    python benchmarks/paper_figures.py docs/images/paper_small.png

Left: the published method with 4, 10 and 20 epochs (rows of quality.py). Middle: dual annealing
with denoised points and without (rows of moves.py and paper.py). Right: each descent of
`prb_projective`, its loss at the start and at the end (rows of gradients.py); above the diagonal it
went away from the answer.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rows import Row, read

from fide_lab.report import plots

RESULTS = Path(__file__).parent / "results"
EPOCHS = (4, 10, 20)
STARTS = ("center", "random", "near")
MARKERS = {"glass": "o", "diffuse": "^"}


def of(rows: list[Row], **settings: Any) -> list[Row]:
    """Rows with these entries."""
    return [row for row in rows if all(row.get(name) == value for name, value in settings.items())]


def draw_epochs(axes: Any) -> None:
    """Voronoi, target 0: a curve for each number of epochs, with the seconds of its run."""
    rows = read(RESULTS / "quality.jsonl")
    for i, epochs in enumerate(EPOCHS):
        (row,) = of(rows, configuration=f"FIDE paper, {epochs} epochs", task="voronoi", target=0)
        draw_curve(axes, row["best"], i, f"{epochs} epochs, {row['wall_s']:.0f} s")
    describe(axes, "published method, epochs and time")


def draw_annealing(axes: Any) -> None:
    """Voronoi, target 0: dual annealing alone, and with the published denoiser."""
    (inside,) = read(RESULTS / "annealing.jsonl")
    about = {"task": "voronoi", "target": 0, "loss": "mse", "configuration": "dual annealing"}
    (alone,) = of(read(RESULTS / "paper.jsonl"), **about)
    draw_curve(axes, {m: each["mse"] for m, each in alone["cross"].items()}, 0, "dual annealing")
    draw_curve(axes, inside["marks"], 1, "with denoised points")
    describe(axes, "dual annealing inside")


def draw_curve(axes: Any, losses: Mapping[str, float], number: int, label: str) -> None:
    """The lowest loss after so many renders."""
    style = plots.style(number)
    axes.plot(
        [int(mark) for mark in losses], losses.values(),
        color=style.color, marker=plots.MARKERS[number], markersize=4, label=label,
    )  # fmt: skip


def describe(axes: Any, title: str) -> None:
    """Logarithmic axes of renders and of the mean squared error."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("renders")
    axes.set_ylabel("mean squared error")
    axes.set_title(title, fontsize=9)
    axes.legend(fontsize=8, frameon=False)


def draw_gradients(axes: Any) -> None:
    """Beads: a point for each descent, by material and by where it began."""
    descents = of(read(RESULTS / "gradients.jsonl"), optimizer="prb_projective")
    for material, marker in MARKERS.items():
        for i, start in enumerate(STARTS):
            mine = of(descents, material=material, start=start)
            axes.scatter(
                [row["first"] for row in mine], [row["last"] for row in mine],
                color=plots.style(i).color, marker=marker, s=16, label=f"{material}, {start}",
            )  # fmt: skip
    ends = [row[which] for row in descents for which in ("first", "last")]
    axes.plot([min(ends), max(ends)], [min(ends), max(ends)], color=plots.MUTED, linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("loss at the start")
    axes.set_ylabel("loss at the end")
    axes.set_title("prb_projective on Beads", fontsize=9)
    axes.xaxis.set_minor_formatter("")
    axes.legend(fontsize=7, frameon=False, loc="lower right")


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("picture", type=Path, metavar="PNG")
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    panels = figure.subplots(1, 3)
    for draw, axes in zip((draw_epochs, draw_annealing, draw_gradients), panels, strict=True):
        draw(axes)
    figure.savefig(parser.parse_args().picture, dpi=90)


if __name__ == "__main__":
    main()
