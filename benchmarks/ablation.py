"""What each component of FIDE contributes: the loss without it, at equal renders.

    python benchmarks/ablation.py voronoi spline --out runs/ablation.jsonl
    python benchmarks/ablation.py --table runs/ablation.jsonl

Runs, files and `--part` work as in `quality.py`.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from quality import Configurations, grid, read, run_missing, table

NOTHING_PROPOSED: dict[str, Any] = {
    "share": 0.0,
    "smallest_share": 0.0,
    "largest_share": 0.0,
    "share_rate": 0.0,
}
DIFFUSION = "proposer: diffusion network"
CHANGES: dict[str, dict[str, Any]] = {
    "FIDE": {},
    "nothing proposed": NOTHING_PROPOSED,
    "nothing proposed, restarts anew": {"proposer": "none"},
    "restarts anew": {"restarts": "anew"},
    "one search to the end": {"restarts": "none"},
    "patience of 6 generations": {"patience": 6},
    "patience of 25 generations (accurate)": {"patience": 25},
    "view: 3 channels": {"views": (3,)},
    "view: all 20 channels": {"views": (20,)},
    "encoder: patch": {"encoder": "patch"},
    "weights: the best tenth counts": {"rank_weight_scale": 0.1},
    "source: the best candidate only": {"sources": 1},
    "all of the way, no noise": {"shortest_step": 1.0, "longest_step": 1.0, "noise": 0.0},
    "proposed without evidence": {"evidence": 0.0},
    "share fixed at 0.3": {"share_rate": 0.0},
    "injected candidates not guarded": {"guard_search": False},
    "memory of 2 generations": {"memory": 2},
    "memory of 6 generations": {"memory": 6},
    "memory of 12 generations": {"memory": 12},
    "memory of 3 generations, view: 3 channels (fast)": {"memory": 3, "views": (3,)},
    "population of 30": {"popsize": 30},
    DIFFUSION: {"proposer": "diffusion", "encoder": "patch", "share": 0.3},
}
CONFIGURATIONS: Configurations = {
    configuration: ("fide", options) for configuration, options in CHANGES.items()
}


def main() -> None:
    """Run what is missing, or print the table."""
    arguments = parse_arguments()
    if arguments.table:
        print(table(read(arguments.table), CONFIGURATIONS))
        return
    run_missing(grid(arguments), CONFIGURATIONS, arguments.out, arguments.part)


def parse_arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("tasks", nargs="*", help="voronoi, spline")
    parser.add_argument(
        "--configurations",
        nargs="+",
        default=list(CONFIGURATIONS),
        metavar="CONFIGURATION",
        choices=CONFIGURATIONS,
    )
    parser.add_argument("--targets", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--size", type=int, default=112)
    parser.add_argument("--budget", type=int, default=4000)
    parser.add_argument("--out", type=Path, default=Path("runs/ablation.jsonl"))
    parser.add_argument("--part", default="0/1")
    parser.add_argument("--table", type=Path, nargs="+")
    return parser.parse_args()


if __name__ == "__main__":
    main()
