"""The POV-Ray scene of the examples: how often the integer and the choice are found.

    python benchmarks/povray.py --seeds 0-9 --out runs/povray.jsonl
    python benchmarks/povray.py --table --out runs/povray.jsonl

The command of docs/reference/own_renderer.md at 64 x 64 pixels, 1,500 renders a seed, default
options.  Eight candidates are asked, rendered at once and told together, so a seed gives the same
run whatever the machine does meanwhile.  Every run is one line of the output file; a second call
does what is missing, and several calls may share the seeds.  A run takes two to three minutes,
mostly waiting for POV-Ray to start.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from moves import span
from rows import Row, read, run_missing

from fide_plugins import FIDE, Space
from fide_plugins.renderers import CommandRenderer

ROOT = Path(__file__).parents[1]
BUDGET, AT_ONCE, SIZE = 1500, 8, 64
TRUTH: dict[str, Any] = {
    "azimuth": 25.0, "elevation": 18.0, "sun": -50.0, "sun_height": 42.0,
    "ball": {"x": 0.4, "z": -0.6}, "radius": 0.7, "red": 0.85, "green": 0.3, "roughness": 0.02,
    "columns": 6, "floor": "checker",
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=span, default=range(10), metavar="A-B")
    parser.add_argument("--out", type=Path, default=Path("runs/povray.jsonl"))
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    out = arguments.out.resolve()
    if arguments.table:
        print(table(read(out)))
        return
    os.chdir(ROOT / "examples" / "povray")  # where scene.pov is
    planned = ({"seed": seed} for seed in arguments.seeds)
    run_missing(planned, lambda run: one_run(run["seed"]), out, lambda row: row["seed"])


def renderer() -> CommandRenderer:
    """The documented command, at 64 x 64 pixels."""
    text = (ROOT / "docs" / "reference" / "own_renderer.md").read_text("utf-8")
    found = re.search(r"^    fide (fit target\.png .*?)\n\n", text, re.MULTILINE | re.DOTALL)
    assert found is not None, "docs/reference/own_renderer.md has no such command"
    words = shlex.split(found[1])
    template = words[words.index("--command") + 1]
    return CommandRenderer(
        template.replace("+W96 +H96", f"+W{SIZE} +H{SIZE}"), Space.read("space.toml")
    )


def one_run(seed: int) -> Row:
    """The best parameters of one run, and the renders after which they were right for good."""
    render = renderer()
    opt = FIDE(render.space, render(TRUTH), seed=seed)
    right_since = None
    with ThreadPoolExecutor(AT_ONCE) as pool:
        while opt.evaluations < BUDGET:
            X = opt.ask(min(AT_ONCE, BUDGET - opt.evaluations))
            images = list(pool.map(render, render.space.decode_many(X)))
            opt.tell(X, np.array(images))
            right = opt.best is not None and is_right(opt.best.params)
            right_since = (right_since or opt.evaluations) if right else None
    assert opt.best is not None
    found = {"loss": opt.best.loss, "params": opt.best.params, "right_since": right_since}
    return {"seed": seed, "renders": opt.evaluations, **found}


def is_right(params: Any) -> bool:
    return all(params[name] == TRUTH[name] for name in ("columns", "floor"))


def table(rows: list[Row]) -> str:
    rows = sorted(rows, key=lambda row: row["seed"])
    lines = ["| seed | loss | columns | floor | right since |", "|---|---|---|---|---|"]
    for row in rows:
        params, since = row["params"], row["right_since"] or "not right"
        values = row["seed"], f"{row['loss']:.2g}", params["columns"], params["floor"], since
        lines.append(f"| {' | '.join(map(str, values))} |")
    right = sum(is_right(row["params"]) for row in rows)
    return "\n".join([*lines, f"{right} of {len(rows)} with the right columns and floor"])


if __name__ == "__main__":
    main()
