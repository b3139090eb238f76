"""Show distinct candidates of a run, best first, side by side: as a picture and as a table.

    fide solutions runs/scene
    fide solutions runs/scene -k 3 -o answers.png
    fide solutions runs/scene --encoder features.py:blocks

A picture may have several explanations. Each column of the table is one of them, with its loss, its
parameters in their units, and their standard deviations where they are known. Parameters that the
picture does not determine are named. Nothing is rendered. A run with an encoder of your own needs
it again; nothing in the directory is executed.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import Any

from fide_lab.cli.running import write_figure
from fide_plugins.cli.arguments import path, whole
from fide_plugins.cli.terminal import USAGE_ERRORS, complain, number, plain
from fide_plugins.runtime.registry import Referent


def own_encoder(reference: str) -> Callable[..., Any]:
    """Return the encoder at ``FILE.py:NAME`` or ``module:NAME``; raises OptionError."""
    form = "write FILE.py:NAME or module:NAME, such as features.py:blocks"
    known = Referent("encoder", "a function of images", form)
    place, name = known.split(reference)
    return known.attribute(known.load(place), place, name)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``fide solutions``."""
    add = parser.add_argument
    add("directory", type=path, metavar="DIR", help="run directory")
    add("-o", "--output", type=path, metavar="FILE", help="the picture (DIR/solutions.png)")
    add("-k", type=whole(1), default=5, metavar="K", help="at most so many (5)")
    add("--encoder", metavar="FILE.py:NAME", help="your own, if the run was made with one")
    add("--json", action="store_true", help="one line of JSON instead of the table")


def execute(args: argparse.Namespace, command: list[str]) -> int:
    """Execute the command; returns the exit code."""
    from fide_lab import solutions
    from fide_plugins.recording.parameters import rows, solutions_as_data

    try:
        encoder = None if args.encoder is None else own_encoder(args.encoder)
        found = solutions.read(args.directory, args.k, encoder)
        if not found.solutions:
            return complain("fide solutions", f"{args.directory} has no image yet; let it run")
        who, output = "fide solutions", args.output or args.directory / "solutions.png"
        if write_figure(who, output, lambda: solutions.figure(found)) is None:
            if args.output is not None:
                return 2
            output = None
    except USAGE_ERRORS as error:
        return complain("fide solutions", error)
    if args.json:
        more = ({"params": s.params, "undetermined": s.undetermined} for s in found.solutions)
        data = [a | b for a, b in zip(solutions_as_data(found.solutions), more, strict=True)]
        print(json.dumps(data, allow_nan=False))
        return 0
    print("\n".join(_table(found, rows(found.solutions))))
    if output is not None:
        print(f"look at {plain(output)}")
    return 0


def _table(found: Any, rows: Any) -> list[str]:
    """Lines of the table: one column a solution."""
    from fide_plugins.recording.parameters import ROUGH, is_rough

    head = [("solution", [str(i + 1) for i in range(len(found.solutions))])]
    head += [(f"loss ({plain(found.loss)})", [number(one.loss) for one in found.solutions])]
    if found.solutions[0].probability is not None:
        head += [("probability", [f"{one.probability:.3f}" for one in found.solutions])]
    cells = head + [(plain(row.label), [plain(value) for value in row.values]) for row in rows]
    first = max(len(name) for name, _ in cells)
    widths = [max(len(values[i]) for _, values in cells) for i in range(len(found.solutions))]
    lines = [
        "  ".join([f"{name:{first}}", *(f"{v:>{w}}" for v, w in zip(values, widths, strict=True))])
        for name, values in cells
    ]
    if any("±" in value for row in rows for value in row.values):
        lines.append(
            "± one standard deviation: how far the truth may be from this answer, by noise and by "
            "what the renderer cannot draw; of other answers it knows nothing"
        )
        rough = [str(i + 1) for i, one in enumerate(found.solutions) if is_rough(one)]
        if rough:
            lines.append(f"{ROUGH}: solution {', '.join(rough)}")
    open_ones = [plain(row.label) for row in rows if not row.determined]
    if open_ones:
        lines.append(f"not determined by the picture: {', '.join(open_ones)}")
    return lines
