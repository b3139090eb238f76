"""Which preset for a given time?  Run a small sweep and read it back from its folder.

    python examples/which_setting.py

The same from the command line: fide tradeoff voronoi --preset fast,balanced --size 32 ...
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from fide_lab import compare
from fide_lab.sweep import best_within, combinations_of, configurations, front, write_tables


def main() -> None:
    swept = configurations({"preset": ["fast", "balanced"], "popsize": [10, 30]})
    plan = compare.Plan(
        ("voronoi",), swept, seeds=2, budget=400, size=32, task_options={"cells": 3}
    )
    with tempfile.TemporaryDirectory() as folder:
        compare.run(plan, folder)
        combinations = combinations_of(compare.read(folder))
        print(write_tables(Path(folder), combinations))
    for point in front(combinations, "renders"):
        print(f"{point.cost:5.0f} renders: {point.loss:.5f} with {point.combination.label}")
    best = best_within(combinations, "seconds", 60.0)
    print(f"for a minute: {best.combination.label if best else 'nothing is known'}")


if __name__ == "__main__":
    main()
