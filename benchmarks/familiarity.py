"""What a small model says of pictures that its renderer cannot make, and how sure it is of others.

    python benchmarks/familiarity.py
    python benchmarks/familiarity.py --table

The scene is drawn here: a striped disk on a plain or checked floor, 32 x 24 pixels, seven
parameters, one of which has no effect.  Three models learn it from 1,000 to 3,000 renders, too few
for a scale of their density (`fide_plugins.learning.judging`).

*known*: share of 150 pictures of each kind that `Model.knows` takes for renders; those that are
none should be 0.  *held*: share of 250 fresh renders whose 90 % region holds the truth.
Every model is one line of the output file; a second call does what is missing.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from rows import Row, command

from fide_plugins import Choice, Float, Int, Space, learn
from fide_plugins.learning import Model

Picture: TypeAlias = NDArray[np.float64]

RESULTS = Path(__file__).parent / "results" / "familiarity.jsonl"
MODELS: list[Row] = [
    {"renders": 3000, "passes": 6, "augment": "photograph"},
    {"renders": 2000, "passes": 10, "augment": "none"},
    {"renders": 1000, "passes": 30, "augment": "render"},
]
PICTURES, FRESH = 150, 250
_HYPOTHESES, _SEED = 99, 777_003
_Y, _X = np.mgrid[:24, :32]
SPACE = Space(
    x=Float(0, 32),
    y=Float(0, 24),
    radius=Float(2, 10, log=True),
    stripes=Int(1, 4),
    floor=Choice("plain", "checked"),
    bright=Float(0.3, 1),
    hidden=Float(0, 5),
)


def render(params: dict[str, Any]) -> Picture:
    """Image (24, 32, 3) of a disk on a floor."""
    image = np.full((24, 32, 3), 0.2)
    if params["floor"] == "checked":
        image[(_X // 4 + _Y // 4) % 2 == 0] = 0.4
    return with_disk(image, params)


def with_disk(image: Picture, params: dict[str, Any]) -> Picture:
    """The image with a disk in front."""
    image = image.copy()
    disk = np.hypot(_X + 0.5 - params["x"], _Y + 0.5 - params["y"]) < params["radius"]
    image[disk] = params["bright"] * np.array([1, 0.5, 0.2])
    stripe = disk & (_X * params["stripes"] // 8 % 2 == 0)
    image[stripe] = params["bright"] * np.array([0.2, 0.5, 1])
    return image


def two_disks(params: dict[str, Any]) -> Picture:
    """Another disk, on the other side, with other stripes."""
    other = {**params, "x": 32 - params["x"], "y": 24 - params["y"]}
    return with_disk(render(params), {**other, "stripes": params["stripes"] % 4 + 1})


KINDS: dict[str, Callable[[dict[str, Any], dict[str, Any]], Picture]] = {
    "a render": lambda one, other: render(one),
    "half as bright": lambda one, other: 0.5 * render(one),
    "red and blue swapped": lambda one, other: render(one)[..., ::-1],
    "the upper half of one, the lower of another": lambda one, other: np.concatenate(
        [render(one)[:12], render(other)[12:]]
    ),
    "two disks": lambda one, other: two_disks(one),
    "the negative": lambda one, other: 1 - render(one),
    "noise": lambda one, other: np.random.default_rng(int(1e6 * one["x"])).random((24, 32, 3)),
}


def known(model: Model) -> dict[str, float]:
    """Share of pictures of each kind that the model takes for renders."""
    pairs = np.random.default_rng(_SEED).random((PICTURES, 2, SPACE.dim))
    points = [(SPACE.decode(one), SPACE.decode(other)) for one, other in pairs]
    return {
        kind: round(float(np.mean([model.knows(make(*pair)) for pair in points])), 3)
        for kind, make in KINDS.items()
    }


def held(model: Model) -> float:
    """Share of fresh renders whose 90 % region of highest density holds the truth."""
    inside = []
    for u in np.random.default_rng(_SEED + 1).random((FRESH, SPACE.dim)):
        picture = render(SPACE.decode(u))
        drawn = model.sample(picture, _HYPOTHESES)
        density = model.log_prob(picture, np.concatenate([u[None], drawn]))
        inside.append((density[1:] > density[0]).mean() < 0.9)
    return round(float(np.mean(inside)), 3)


def measure(row: Row) -> Row:
    """Learn a model, and ask it."""
    start = time.process_time()
    model = learn(render, SPACE, size=32, **row)
    report = model.report
    return {
        **row,
        "nats": round(-report.nll, 2),
        "judges": report.held_out - report.fitted,
        "coverage": round(report.coverage, 3),
        "unseen": list(report.unseen),
        "known": known(model),
        "held": held(model),
        "cpu_s": round(time.process_time() - start, 1),
    }


def table(rows: list[Row]) -> str:
    """All models, in Markdown."""
    heads = [f"{row['renders']:,}, {row['passes']}, `{row['augment']}`" for row in rows]
    lines = [f"| renders, passes, `augment` | {' | '.join(heads)} |", "|---|" + "---:|" * len(rows)]
    for kind in KINDS:
        cells = " | ".join(f"{row['known'][kind]:.0%}" for row in rows)
        lines.append(f"| known: {kind} | {cells} |")
    cells = " | ".join(f"{row['held']:.1%}" for row in rows)
    lines.append(f"| 90 % regions hold the truth, {FRESH} fresh renders | {cells} |")
    cells = " | ".join(f"{row['coverage']:.0%} of {row['judges']}" for row in rows)
    lines.append(f"| the same in the report | {cells} |")
    return "\n".join(lines)


def key(row: Row) -> tuple[int, int, str]:
    """What makes a run."""
    return row["renders"], row["passes"], row["augment"]


if __name__ == "__main__":
    command(__doc__ or "", MODELS, measure, RESULTS, key, table)
