"""What each component of FIDE contributes: runs solved, and the loss, without it.

    python benchmarks/ablation.py voronoi8 --targets 110-119 --out runs/ablation.jsonl
    python benchmarks/ablation.py robot --targets 410-419 --out runs/ablation.jsonl
    python benchmarks/ablation.py --table runs/ablation.jsonl

Scenes, targets and files work as in `moves.py`; a configuration is a row of `CONFIGURATIONS`.
"""

from __future__ import annotations

import argparse
import os
import statistics
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

os.environ.setdefault("OMP_NUM_THREADS", "1")

import moves
from rows import Row, read, run_missing

from fide_plugins.proposers import linear
from fide_plugins.search.moves import (
    HalfTurn,
    Known,
    Move,
    RandomRestart,
    Refine,
    RelocateGroup,
    RelocateSegment,
    Split,
)

MARKS = ("500", "1000", "2000", "4000")
NOTHING_PROPOSED: dict[str, Any] = {
    "proposal_fraction": 0.0,
    "fraction_rate": 0.0,
}


class Change(NamedTuple):
    """Options of FIDE without steps that differ from their defaults, and moves that are left out.

    linear: arguments of the linear proposer.
    budget: renders, where not all can be afforded.
    """

    options: dict[str, Any]
    without: tuple[type[Move], ...] = ()
    linear: dict[str, Any] = {}  # noqa: RUF012 - not a class attribute
    budget: int = 4000


DIFFUSION = "proposer: diffusion network"
NO_STEPS: dict[str, Any] = {"proposer": "linear"}
"""Of all rows that say nothing else."""
CONFIGURATIONS: dict[str, Change] = {
    "FIDE": Change({"proposer": "both"}),
    "no steps": Change({}),
    "nothing proposed": Change(NOTHING_PROPOSED),
    "nothing proposed, restarts anew (CMA-ES)": Change({"proposer": "none"}),
    "restarts anew": Change({"restarts": "anew"}),
    "one search to the end": Change({"restarts": "none"}),
    "no split": Change({}, without=(Split,)),
    "no half turn": Change({}, without=(HalfTurn,)),
    "no relocation": Change({}, without=(RelocateGroup, RelocateSegment)),
    "no refinement": Change({}, without=(Refine,)),
    "no beginning anew": Change({}, without=(RandomRestart,)),
    "patience of 10 generations": Change({"patience": 10}),
    "patience of 25 generations (accurate)": Change({"patience": 25}),
    "channels: the first 3": Change({"channel_subsets": (3,)}),
    "channels: all 20": Change({"channel_subsets": (20,)}),
    "encoder: patch": Change({"encoder": "patch"}),
    "weights: the best tenth counts": Change({}, linear={"rank_weight_scale": 0.1}),
    "source: the best candidate only": Change({}, linear={"sources": 1}),
    "all of the way, no noise": Change({}, linear={"step": (1.0, 1.0), "noise": 0.0}),
    "no R2 threshold": Change({}, linear={"r2_threshold": 0.0}),
    "proposal fraction fixed at 0.3": Change({"fraction_rate": 0.0}),
    "images not guarded": Change({"guard_images": False}),
    "injected candidates not guarded": Change({"guard_search": False}),
    "buffer of 2 generations": Change({"buffer_generations": 2}),
    "buffer of 4 generations": Change({"buffer_generations": 4}),
    "buffer of 8 generations": Change({"buffer_generations": 8}),
    "buffer of 3 generations, first 3 channels (fast)": Change({"preset": "fast"}),
    "population of 30": Change({"popsize": 30}),
    DIFFUSION: Change({"proposer": "diffusion", "encoder": "patch"}, budget=2000),
}


def main() -> None:
    """Run what is missing, or print the table."""
    arguments = parse_arguments()
    if arguments.table:
        print(table(read(arguments.table)))
        return
    run_missing(planned_runs(arguments), run, arguments.out, moves.key)


def parse_arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(moves.SCENES))
    parser.add_argument(
        "--configurations",
        nargs="+",
        default=list(CONFIGURATIONS),
        metavar="CONFIGURATION",
        choices=CONFIGURATIONS,
    )
    parser.add_argument("--targets", type=moves.span, default=range(110, 120), metavar="A-B")
    parser.add_argument("--out", type=Path, default=Path("runs/ablation.jsonl"))
    parser.add_argument("--table", type=Path)
    return parser.parse_args()


def planned_runs(arguments: argparse.Namespace) -> Iterator[Row]:
    """All runs, configurations outermost."""
    for name in arguments.configurations:
        for scene in arguments.scenes:
            for target in arguments.targets:
                yield {
                    "scene": scene,
                    "target": target,
                    "seed": 0,
                    "configuration": name,
                    "size": moves.SCENES[scene].size,
                    "budget": CONFIGURATIONS[name].budget,
                }


def run(planned_run: Row) -> Row:
    """One run of FIDE with that change."""
    change = CONFIGURATIONS[planned_run["configuration"]]
    changed = partial(linear.LinearProposer, **change.linear)
    with moves_left_out(change.without), mock.patch.object(linear, "LinearProposer", changed):
        return moves.run(planned_run, "fide", NO_STEPS | change.options)


@contextmanager
def moves_left_out(kinds: tuple[type[Move], ...]) -> Iterator[None]:
    """Say of these moves that they are never possible."""

    def never(move: Move, known: Known) -> bool:
        return False

    with ExitStack() as patches:
        for kind in kinds:
            patches.enter_context(mock.patch.object(kind, "possible", never))
        yield


def table(rows: list[Row]) -> str:
    """Runs solved by each mark, median loss at it, and time of the optimizer, in Markdown."""
    lines = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        lines += [
            f"### {scene}",
            "",
            "| | runs | solved by 1,000 / 2,000 / 4,000 | "
            + " | ".join(f"{int(mark):,}" for mark in MARKS)
            + " | ms |",
            "|---|---:|---|" + "---|" * (len(MARKS) + 1),
        ]
        lines += [
            line_of(name, group)
            for name in CONFIGURATIONS
            if (group := [r for r in rows if (r["scene"], r["configuration"]) == (scene, name)])
        ]
        lines.append("")
    return "\n".join(lines)


def line_of(name: str, group: list[Row]) -> str:
    """The table's line of one configuration of one scene."""
    known = [mark for mark in MARKS if int(mark) <= group[0]["budget"]]
    solved = " / ".join(
        str(sum((row["solved_at"] or 1e9) <= int(mark) for row in group))
        for mark in known
        if mark != "500"
    )
    # a run that ends as solved keeps its last loss
    losses = [
        f"{statistics.median(row['marks'].get(mark, row['best']) for row in group):.5f}"
        if mark in known
        else ""
        for mark in MARKS
    ]
    ms = statistics.median(time_of(row) for row in group)
    return f"| {name} | {len(group)} | {solved} | {' | '.join(losses)} | {ms:.2f} |"


def time_of(row: Row) -> float:
    """Milliseconds of the optimizer for a candidate."""
    return float(sum(row["overhead_ms"].values()))


if __name__ == "__main__":
    main()
